"""A burst is an interval of 0 s: each shot as soon as the body has delivered the last, over the real protocol."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled.daemon.pipeline.repeats import CaptureRequest
from dappled.flight import Frame, LedgerReader
from dappled.mocks.body.body import BodyOptions, SimulatedBody, pattern
from tests.system.flying import flying, settings_of
from tests.waiting import eventually

SIZE, SHOTS = 1_000_001, 5


def test_an_interval_of_0_s_is_a_burst_that_loses_and_doubles_nothing(sockets: Path, tmp_path: Path) -> None:
    here = sockets / tmp_path.name[-12:]
    here.mkdir()
    with (
        SimulatedBody.start(BodyOptions(picture=f"pattern:{SIZE}:cr2")) as body,
        flying(settings_of(here, camera={"port": body.port})) as daemon,
    ):
        daemon.until_ready()
        verdict = daemon.service.parts.shutter.start_interval(CaptureRequest("test", "console", 1), 0.0, SHOTS)
        assert verdict.outcome != "refused", verdict.reason
        eventually(lambda: len(daemon.shots) == SHOTS, "the burst's end")
        assert body.releases == SHOTS
        with LedgerReader.open(daemon.service.folder / "flight.sqlite") as ledger:
            frames = sorted(ledger.frames(), key=lambda frame: frame.index)
            rows = [ledger.shot(frame.index) for frame in frames]
        assert [frame.index for frame in frames] == list(range(SHOTS))
        for number, frame in enumerate(frames, 1):
            assert (daemon.service.folder / frame.name).read_bytes() == pattern(number, SIZE)
        assert sorted(row.fired_called_monotonic_ns for row in rows if row and row.fired_called_monotonic_ns) == [
            row.fired_called_monotonic_ns for row in rows if row
        ]


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.parametrize(
    "fault", ["unplug", *(pytest.param(other, marks=pytest.mark.long) for other in ("drop-transfer", "no-event"))]
)
def test_in_a_burst_each_shot_ends_once_whatever_the_body_does(sockets: Path, tmp_path: Path, fault: str) -> None:
    here = sockets / tmp_path.name[-12:]
    here.mkdir()
    with (
        SimulatedBody.start(BodyOptions(picture=f"pattern:{SIZE}:cr2", delay_s=0.1)) as body,
        flying(settings_of(here, camera={"port": body.port, "file_timeout_s": 20})) as daemon,
    ):
        daemon.until_ready()
        shutter = daemon.service.parts.shutter

        def safe() -> list[Frame]:
            return [pending.frame for pending in list(daemon.shots) if pending.frame is not None]

        assert shutter.start_interval(CaptureRequest("test", "console", 1), 0.0, 0).outcome == "shot"
        eventually(lambda: len(daemon.shots) >= 2, "two shots of the burst")
        body.fault(fault)
        if fault == "unplug":
            eventually(lambda: daemon.camera == "absent", "the camera is absent")
            body.fault("clear")
        seen = len(safe())
        eventually(lambda: len(safe()) >= seen + 3, "the burst goes on by itself", 60)
        shutter.stop_interval()
        eventually(lambda: shutter.statistics().pending == 0, "the last shot's end")
        shots = shutter.statistics().shots
        eventually(lambda: len(daemon.shots) == shots, "every shot's end")
        assert len(safe()) + sum(bool(pending.problem) for pending in daemon.shots) == shots  # a frame, or why not
        pictures = {(daemon.service.folder / frame.name).read_bytes() for frame in safe()}
        assert len(pictures) == len(safe()), "one picture became two frames"
