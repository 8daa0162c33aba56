"""A body that a wire fires and whose files come over PTP: all that a driver must do."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

import pytest

from dappled.drivers.camera import CameraError, Identity
from dappled.drivers.wired import composed
from dappled.drivers.wired.composed import ComposedCamera, ComposedSettings
from dappled.drivers.wired.ptp_source import PtpSource
from dappled.mocks.body.body import BodyOptions, SimulatedBody, pattern
from dappled.testing import CameraContract, Rig

SIZE = 100_001
_PATIENCE_S = 20.0


class Wire:
    """A line to the body's remote socket. The contact stays closed until the body, which may be busy, has fired."""

    def __init__(self, body: SimulatedBody) -> None:
        self._body = body

    def open(self) -> None: ...
    def let_go(self) -> None: ...
    def close(self) -> None: ...

    def press(self) -> None:
        deadline = time.monotonic() + _PATIENCE_S
        while not self._body.contact():
            if time.monotonic() > deadline:
                raise CameraError("the body did not fire")
            time.sleep(0.005)


@pytest.mark.slow
class TestContractOfAWireAndPtp(CameraContract):
    """The fujifilm driver with `pickup = "ptpip:…"`: each shot is deferred, and its file follows from the card."""

    @pytest.fixture
    def rig(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
        monkeypatch.setattr(composed, "_FIRST_LOOK_S", 60.0)  # one shot alone is sure only on a card seen before it
        with SimulatedBody.start(BodyOptions(picture=f"pattern:{SIZE}:cr2")) as body:
            plan = ComposedSettings(follows="it follows", hold_s=0.01, poll_s=0.1)
            identity = Identity("Canon", "EOS 450D", "", "wire")
            camera = ComposedCamera(identity, Wire(body), PtpSource(body.port), plan)
            yield Rig(camera, partial(pattern, size=SIZE), loose=True, follows=True)
            camera.stop()
            for loop in camera._loops:
                loop.stop(_PATIENCE_S)  # it may be at the camera still
