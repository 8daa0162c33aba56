"""Which component ArduPilot's parameters name as this camera."""

from __future__ import annotations

import math
from collections.abc import Iterator

from dappled.drivers.mavlink import MavlinkMessage, mavlink
from dappled.findings import Code, Finding, Subject, finding

_AGAIN_NS = 5 * 10**9
_TIMES = 3  # ArduPilot before 4.8 has no CAMn_COMPID, and doesn't answer
_MAVLINK_CAMERA = 6  # CAMn_TYPE
_FIRST = 100


class NamedComponent:
    """CAMn_TYPE and CAMn_COMPID of the camera with this number at the autopilot (`cam_idx`, from 0): whether they name
    our `component_id`. A change that a ground station makes is heard, too."""

    def __init__(self, cam_idx: int, component_id: int) -> None:
        self._camera, self._component_id = cam_idx + 1, component_id
        self._values: dict[str, int | None] = {f"CAM{self._camera}_TYPE": None, f"CAM{self._camera}_COMPID": None}
        self._asked = self._due_ns = 0

    def heard(self, message: MavlinkMessage) -> None:
        """Take a PARAM_VALUE of the autopilot."""
        if message.param_id in self._values and math.isfinite(message.param_value):
            self._values[message.param_id] = round(message.param_value)

    def due(self, system: int, now_ns: int) -> Iterator[MavlinkMessage]:
        """Requests for what is not known yet, three times at most."""
        if self._asked >= _TIMES or now_ns < self._due_ns:
            return
        self._asked, self._due_ns = self._asked + 1, now_ns + _AGAIN_NS
        for name, value in self._values.items():
            if value is None:
                yield mavlink.MAVLink_param_request_read_message(system, 1, name.encode(), -1)

    def findings(self) -> list[Finding]:
        """That the autopilot fires another component than this one."""
        kind, named = self._values.values()
        if kind != _MAVLINK_CAMERA or named is None:
            return []
        fires = named or _FIRST + self._camera - 1
        if fires == self._component_id:
            return []
        about, own = Subject("service"), self._component_id
        return [finding(Code.LINK_OTHER_COMPONENT, about, camera=self._camera, named=fires, component=own)]
