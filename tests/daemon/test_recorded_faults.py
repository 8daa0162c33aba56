"""What may go wrong with time and telemetry in flight, recorded and replayed: the tags say what was known, and come out
the same again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from dappled.clock import RecordedClock
from dappled.daemon.navigation import BodyLatency, Telemetry, clocks
from dappled.daemon.pipeline import tagging
from dappled.decode.geometry import Pose
from dappled.drivers.mavlink import MavlinkMessage, PacketParser, mavlink
from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.flight import Cause, LedgerReader, Result, Shot, recording
from dappled.flight.checks.flight_check import check
from dappled.mocks.autopilot.autopilot import BootTime
from dappled.mocks.autopilot.path import FlightPath
from tests.daemon.fakes import rig
from tests.daemon.replay.test_replay import again
from tests.flight.makers import held
from tests.simulated.vehicle import flight

START_NS = 1_790_000_000 * 10**9
PATH = FlightPath(3, speed_m_s=8.0)
LATENCY = BodyLatency(60.0, 15.0)  # what `again` replays with
Packets = Iterator[tuple[float, MavlinkMessage]]
LINK_S = 0.005


def healthy() -> Packets:
    yield from flight(PATH, BootTime(), 0, 40)


def with_a_gap() -> Packets:
    """Nothing for 4 s around the exposure at 20 s, as where the link is shaded."""
    yield from ((t_s, message) for t_s, message in healthy() if abs(t_s - 20.06) > 2)


def with_a_reboot() -> Packets:
    """The autopilot restarts in mid-air, is silent for 1.5 s, and counts from 0 again."""
    yield from flight(PATH, BootTime(), 0, 20.3)
    yield from flight(PATH, BootTime(offset_s=-21.8), 21.8, 40)


def fly(flights: Path, packets: Packets, exposures_s: list[float]) -> Path:
    """Record what the daemon would: every packet, and a frame for each trigger call, tagged 0.4 s afterwards."""
    begun = recording.begin(flights, RecordedClock(START_NS))
    decode = PacketParser()
    telemetry, waiting = Telemetry(), list(enumerate(exposures_s))

    def shoot(index: int, called_s: float) -> None:
        called_ns = round(called_s * 1e9)
        shot = Shot(index, Cause("test", "console", index), START_NS + called_ns, called_ns)
        begun.journal.note(shot)
        begun.ledger.add_shot(shot)
        begun.ledger.fired(index, called_ns, called_ns)
        with held(b"frame %d" % index) as blob:
            frame = begun.recorder.record(index, "IMG.DNG", blob, arrived_utc_ns=START_NS + called_ns + 10**8)
        exposure, pose = telemetry.locate(clocks.mid_exposure(START_NS + called_ns, LATENCY, None))
        begun.ledger.add_tag(tagging.tag(frame, exposure, ExposureSettings(), camera="test", mask="mask", pose=pose))
        begun.ledger.add_result(Result(index, "0" * 64, 1, 1, "geometric", "calibrated"))

    for t_s, message in packets:
        while waiting and t_s > waiting[0][1] + 0.4:
            shoot(*waiting.pop(0))
        raw = bytes(message.pack(mavlink.MAVLink(None, srcSystem=1, srcComponent=1)))
        stamp_us = START_NS // 1000 + round((t_s + LINK_S) * 1e6)
        telemetry.feed(begun.telemetry.append(stamp_us, raw), stamp_us, decode(raw))
    begun.close()
    assert check(begun.folder.path).problems == ()
    return begun.folder.path


def poses(folder: Path) -> list[Pose]:
    with LedgerReader.open(folder / "flight.sqlite") as ledger:
        return [pose for _, pose in sorted(ledger.poses().items())]


def error_m(pose: Pose) -> float:
    """Horizontal, roughly: enough to tell a right place from a wrong one."""
    truth = PATH.pose((pose.utc_ns - START_NS) / 1e9)
    assert pose.latitude_rad is not None
    assert pose.longitude_rad is not None
    north = (pose.latitude_rad * 57.29577951 - truth.latitude_deg) * 111_000
    east = (pose.longitude_rad * 57.29577951 - truth.longitude_deg) * 83_000
    return float((north**2 + east**2) ** 0.5)


@pytest.mark.parametrize("packets", [healthy, with_a_gap, with_a_reboot])
def test_the_same_tags_come_out_of_the_replay(tmp_path: Path, packets: Callable[[], Packets]) -> None:
    folder = fly(tmp_path, packets(), [10.0, 20.0, 22.5, 30.0])
    assert again(folder) == []


def test_a_telemetry_gap_at_the_exposure(tmp_path: Path) -> None:
    before, within, at_its_end, after = poses(fly(tmp_path, with_a_gap(), [10.0, 20.0, 22.5, 30.0]))
    assert [pose.source for pose in (before, within, at_its_end, after)] == [
        "interpolated",
        "nearest",
        "interpolated",
        "interpolated",
    ]
    assert within.age_ms == pytest.approx(1960, abs=110)
    assert within.position_sigma_m is not None
    assert error_m(within) < 2 * within.position_sigma_m
    assert within.position_sigma_m > 10
    for pose in (before, at_its_end, after):
        assert error_m(pose) < 0.3


def test_an_autopilot_reboot(tmp_path: Path) -> None:
    """Nothing of the time before is bridged to the time after; and after it the poses are right again."""
    before, at_it, just_after, after = poses(fly(tmp_path, with_a_reboot(), [10.0, 20.2, 22.5, 30.0]))
    assert before.source == after.source == "interpolated"
    assert error_m(before) < 0.3
    assert error_m(after) < 0.3
    assert at_it.source == "nearest"
    assert just_after.source == "interpolated"
    assert error_m(just_after) < 0.3
    assert after.boot_us is not None
    assert after.boot_us < 12_000_000


@pytest.mark.parametrize("step_s", [3600, -3600])
def test_a_clock_stepped_by_an_hour(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step_s: int) -> None:
    """NTP, or a person, sets the machine's clock in mid-flight: no stamp of the flight jumps, and it replays."""
    truly = time.time_ns
    with rig(tmp_path) as one:
        one.request(0)
        one.ended(0)
        monkeypatch.setattr(time, "time_ns", lambda: truly() + step_s * 10**9)
        for number in (1, 2):
            one.request(number)
            one.ended(number)
        rows, frames = one.flight.ledger.shots(), one.flight.ledger.frames()
        events = one.flight.ledger.events()
    offsets = {row.shot.wished_utc_ns - row.shot.wished_monotonic_ns for row in rows}
    assert len(offsets) == 1
    arrivals = [frame.arrived_utc_ns for frame in frames]
    assert all(0 < later - earlier < 60 * 10**9 for earlier, later in pairwise(arrivals))
    assert all(abs(event.utc_ns - arrivals[0]) < 60 * 10**9 for event in events)
    assert check(one.flight.folder.path).problems == ()
    assert again(one.flight.folder.path) == []
