"""A burst is an interval of 0 s: each shot as soon as the body has delivered the last, over the real protocol."""

from __future__ import annotations

from pathlib import Path

from dappled.daemon.shutter import Wish
from dappled.flight.ledger import LedgerReader
from dappled.mocks.body import Body, BodyOptions
from dappled.mocks.pictures import pattern
from tests.system.flying import eventually, flying, settings_of

SIZE, SHOTS = 1_000_001, 5


def test_an_interval_of_0_s_is_a_burst_that_loses_and_doubles_nothing(sockets: Path, tmp_path: Path) -> None:
    here = sockets / tmp_path.name[-12:]
    here.mkdir()
    with (
        Body.start(BodyOptions(picture=f"pattern:{SIZE}:cr2")) as body,
        flying(settings_of(here, camera={"port": body.port})) as daemon,
    ):
        daemon.until_ready()
        verdict = daemon.service._parts.shutter.start_interval(Wish("test", "console", 1), 0.0, SHOTS)
        assert verdict.outcome != "refused", verdict.reason
        eventually(lambda: len(daemon.stories) == SHOTS, "the burst's end")
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
