"""Settings by name: whoever asks for a value hears how it ended, whatever comes in between."""

from __future__ import annotations

import struct
from collections.abc import Callable

from dappled.daemon.camera_protocol.camera_settings import Knobs, code
from dappled.daemon.camera_protocol.parameters import TYPE, WAIT_NS, Parameters
from dappled.drivers.camera import Setting, SettingName
from dappled.drivers.mavlink.links import Message, mavlink


class Body:
    """A body that never takes a change. `meanwhile` happens once, the next time that its settings are looked at."""

    def __init__(self) -> None:
        self.meanwhile: Callable[[], object] | None = None

    def settings(self) -> tuple[Setting, ...]:
        now, self.meanwhile = self.meanwhile, None
        if now is not None:
            now()
        return (Setting("iso", "100", ("100", "200", "400")),)

    def change(self, name: SettingName, value: str) -> None:
        """Asked, and deaf."""


def wanted(value: str) -> Message:
    """A PARAM_EXT_SET as it is received."""
    data = struct.pack("<I", code(value)).ljust(128, b"\0")
    sent = mavlink.MAVLink_param_ext_set_message(1, 100, b"CAM_ISO", data, TYPE)
    return mavlink.MAVLink(None).decode(bytearray(sent.pack(mavlink.MAVLink(None))))


def results(replies: list[Message]) -> list[int]:
    return [message.param_result for message in replies]


def test_a_value_asked_for_while_another_one_runs_out_is_answered_too() -> None:
    body = Body()
    parameters = Parameters(Knobs(body))
    first = parameters.set(wanted("200"), 0, 0)
    assert results(list(first.messages)) == [mavlink.PARAM_ACK_IN_PROGRESS]
    body.meanwhile = lambda: parameters.set(wanted("400"), 1, WAIT_NS)
    assert parameters.settled(WAIT_NS) == []  # 200 has given way to 400, which is on its way
    ((link, reply),) = parameters.settled(2 * WAIT_NS)
    assert (link, results(list(reply.messages))) == (1, [mavlink.PARAM_ACK_FAILED])
    assert parameters.settled(3 * WAIT_NS) == []


def test_how_it_ended_is_told_once_though_two_threads_look() -> None:
    body = Body()
    parameters = Parameters(Knobs(body))
    parameters.set(wanted("200"), 0, 0)
    told: list[object] = []
    body.meanwhile = lambda: told.extend(parameters.settled(WAIT_NS))
    told.extend(parameters.settled(WAIT_NS))
    assert len(told) == 1
