"""Marks of PPK: RTKLIB's forms are read, marks find their shots, and whatever doesn't fit is named."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.decode.geometry import camera_pose, from_euler, metres_per_radian
from dappled.errors import DappledError
from dappled.findings import Code, Subject, finding, text, told
from dappled.flight import LedgerReader, TimeSource, recording
from dappled.flight.layout import FlightFolder
from dappled.products.geotags import geotags, marks, pos_file
from dappled.products.geotags.mark_matching import TimedShot, pair
from dappled.products.geotags.marks import Marked
from dappled.products.maps.earth import Geoid
from dappled.products.mounting import Mounting
from tests.flight.makers import deliver, pose, shot, tag

START_NS = 1_795_256_103_000_000_000
GEOID = Geoid(offset_m=-30.0)
HEAD = """% program   : RTKLIB ver.2.4.3 b34
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)\
  sdeu(m)  sdun(m) age(s)  ratio
"""
TIMES_S = (0.0137, 2.1268, 4.0411, 6.7184, 8.9333, 11.0062)  # exposures begin; uneven, as a person shoots
NORTH_M, EAST_M, UP_M = 0.4, -0.3, 0.2  # the marks' positions less the autopilot's

# By Debian's rnx2rtkp 2.4.3 b34 from RTKLIB's sample data (test/data/rinex, 2005-04-02): one solution, four forms.
WEEKS = """% program   : rnx2rtkp ver.2.4.3 b34
% ref pos   : 35.132062994  139.624301322    75.0645
%
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  GPST          latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  sdeu(m)  sdun(m)\
 age(s)  ratio
1316 518400.000   35.160872392  139.613836327    69.9066   1   7   0.0058   0.0044   0.0136   0.0022  -0.0047  -0.0055\
   0.00   24.9
"""
DEGREES_IN_UTC = """% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  UTC         ,   latitude(d'"),  longitude(d'"), height(m),  Q, ns,  sdn(m),  sde(m),  sdu(m), sdne(m), sdeu(m),\
 sdue(m),age(s), ratio
1316,518387.000,  35,09,39.14061, 139,36,49.81078,   69.9066,  1,  7,  0.0058,  0.0044,  0.0136,  0.0022, -0.0047,\
 -0.0055,  0.00,  24.9
"""
ECEF = """%  GPST              x-ecef(m)      y-ecef(m)      z-ecef(m)   Q  ns   sdx(m)   sdy(m)   sdz(m)  sdxy(m)\
  sdyz(m)  sdzx(m) age(s)  ratio
1316 518400.000  -3976219.4286   3382372.6101   3652512.6026   1   7   0.0091   0.0100   0.0074  -0.0086   0.0068\
  -0.0064   0.00   24.9
"""
BASELINES = """%  GPST          e-baseline(m)  n-baseline(m)  u-baseline(m)   Q  ns   sde(m)   sdn(m)   sdu(m)
1316 518400.000      -953.3382      3196.2362        -6.4048   1   7   0.0044   0.0058   0.0136
"""


def pos(folder: Path, text: str) -> Path:
    path = folder / "rover_events.pos"
    path.write_text(text)
    return path


@pytest.mark.parametrize("text", [WEEKS, DEGREES_IN_UTC, ECEF])
def test_the_forms_of_rtklib_give_the_same_mark(text: str, tmp_path: Path) -> None:
    (mark,) = pos_file.read(pos(tmp_path, text)).marks
    assert mark.utc_ns == int(datetime(2005, 4, 1, 23, 59, 47, tzinfo=UTC).timestamp()) * 10**9  # 13 leap seconds
    assert math.degrees(mark.latitude_rad) == pytest.approx(35.160872392, abs=2e-9)
    assert math.degrees(mark.longitude_rad) == pytest.approx(139.613836327, abs=2e-9)
    assert mark.height_m == pytest.approx(69.9066, abs=2e-4)
    assert (mark.quality, mark.satellites) == (1, 7)
    assert mark.covariance_m2 is not None
    nn, ne, nd, ee, ed, dd = mark.covariance_m2
    assert [math.sqrt(one) for one in (nn, ee, dd)] == pytest.approx([0.0058, 0.0044, 0.0136], abs=1.5e-4)
    assert [ne, nd, ed] == pytest.approx([0.0022**2, 0.0055**2, 0.0047**2], abs=2e-6)  # east and up → east and down


def test_time_is_gps_s_own_up_to_the_leap_second() -> None:
    first_ns = pos_file._utc_ns("2017/01/01", "00:00:17.999", "GPST")
    second_ns = pos_file._utc_ns("2017/01/01", "00:00:18.5", "GPST")
    assert second_ns - first_ns == 501_000_000 - 10**9  # UTC counts a 61st second
    assert second_ns == int(datetime(2017, 1, 1, tzinfo=UTC).timestamp()) * 10**9 + 500_000_000
    assert pos_file._utc_ns("2026/11/21", "19:15:03", "JST") == pos_file._utc_ns("2026/11/21", "10:15:21", "GPST")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (HEAD, "holds no mark"),
        (WEEKS.splitlines()[-1], "no header"),
        (BASELINES, "holds baselines"),
        (HEAD.replace("WGS84", "Tokyo") + "2026/11/21 10:00:00 35 139 1 1 9\n", "datum Tokyo"),
        (HEAD + "2026/11/21 10:00:00 35 139 x 1 9\n" * 2, "line 4 is not a position"),
        (HEAD + "2026/11/21 10:00:00 135 139 1 1 9\n" * 2, "line 4 is not a position"),
        (HEAD + "2026/11/21 25:00:00 35 139 1 1 9\n" * 2, "line 4 is not a position"),
        (HEAD + "2026/11/21 10:00:00 35 139 1 1 -9\n" * 2, "line 4 is not a position"),
        ("% GPST latitude(deg) longitude(deg)\n", "lacks latitude, longitude, height, Q"),
    ],
)
def test_a_file_that_holds_no_marks_is_one_sentence(text: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(DappledError, match=says):
        pos_file.read(pos(tmp_path, text))


def test_a_torn_last_line_is_said_and_left_out(tmp_path: Path) -> None:
    line = "2026/11/21 10:00:00.000 35.0 139.0 1.0 1 9 0.01 0.01 0.02 0 0 0 0 9\n"
    found = pos_file.read(pos(tmp_path, HEAD + line + line[:30]))
    assert len(found.marks) == 1
    assert [one.code for one in found.doubts] == [Code.MARKS_CUT_SHORT]


def fly(root: Path, *, utc_known: bool = True, times_s: Sequence[float] = TIMES_S, latency_s: float = 0.02) -> Path:
    """A flight whose tags say `latency_s` too late, and whose frames were exposed for 1/500 s."""
    begun = recording.begin(root / "flights", RecordedClock(START_NS), utc_known=utc_known)
    for index, at_s in enumerate(times_s):
        called_ns = START_NS + round(at_s * 1e9)
        one = replace(shot(index), wished_utc_ns=called_ns, wished_monotonic_ns=called_ns - START_NS)
        begun.journal.note(one)
        begun.ledger.add_shot(one)
        begun.ledger.fired(index, called_ns - START_NS, called_ns - START_NS + 1000)
        frame = deliver(begun, index, b"raw %d" % index, f"IMG_{index:04d}.CR2")
        where = replace(pose(), attitude=from_euler(0.0, 0.0, math.pi / 2), velocity_ned_m_s=(10.0, 0.0, 0.0))
        late_ns = round(latency_s * 1e9)
        begun.ledger.add_tag(
            replace(tag(frame), utc_ns=called_ns + late_ns + 1_000_000, utc_sigma_ns=20_000_000, exposure_s=0.002,
                    pose=where)
        )  # fmt: skip
    begun.close()
    return begun.folder.path


def line(at_s: float, quality: int = 1, north_m: float = NORTH_M, up_m: float = UP_M) -> str:
    """A mark beside the autopilot's position, in GPS time."""
    where = pose()
    assert where.latitude_rad is not None
    assert where.longitude_rad is not None
    assert where.altitude_msl_m is not None
    north, east = metres_per_radian(where.latitude_rad, where.altitude_msl_m)
    gps = datetime.fromtimestamp(START_NS / 1e9, UTC) + timedelta(seconds=at_s + 18)
    latitude = math.degrees(where.latitude_rad + north_m / north)
    longitude = math.degrees(where.longitude_rad + EAST_M / east)
    height = where.altitude_msl_m - 30.0 + up_m
    sigmas = "0.0060 0.0080 0.0150 0.0020 -0.0030 0.0040 0.00 9.9"
    return f"{gps:%Y/%m/%d %H:%M:%S.%f} {latitude:.9f} {longitude:.9f} {height:.4f} {quality} 12 {sigmas}\n"


def find(flight: Path, lines: Sequence[str]) -> Marked:
    return marks.find(flight, pos(flight.parent, HEAD + "".join(lines)), GEOID)


def test_every_shot_finds_its_mark_and_its_position(tmp_path: Path) -> None:
    flight = fly(tmp_path)
    found = find(flight, [line(at_s) for at_s in TIMES_S])
    assert sorted(found.marks) == list(range(6))
    assert (found.lost, found.extra, found.doubts) == ((), (), ())
    assert found.offset_s == pytest.approx(0.02, abs=1e-6)
    assert found.shift_m == pytest.approx((NORTH_M, EAST_M, UP_M), abs=1e-3)
    placed, _ = geotags.read(flight, geotags.PlacedBy(Mounting(lever_m=(0.5, 0.0, 0.1)), GEOID, found))
    first = placed[0]
    assert first.camera is not None
    assert first.camera.height_ellipsoid_m is not None
    assert first.utc_ns == START_NS + 14_700_000  # the mark, and half of the exposure
    where = pose()
    assert where.latitude_rad is not None
    assert where.longitude_rad is not None
    north, east = metres_per_radian(where.latitude_rad, 200.0)
    moved_north = (math.radians(first.camera.latitude_deg) - where.latitude_rad) * north
    moved_east = (math.radians(first.camera.longitude_deg) - where.longitude_rad) * east
    assert moved_north == pytest.approx(NORTH_M + 10.0 * 0.001, abs=1e-3)  # 1 ms further at 10 m/s
    assert moved_east == pytest.approx(EAST_M + 0.5, abs=1e-3)  # the nose, and the lever arm, point east
    assert first.camera.height_ellipsoid_m == pytest.approx(215.1 - 30.0 + UP_M - 0.1, abs=1e-3)
    tagged = first.tag.pose
    assert tagged.position_sigma_m == pytest.approx(math.hypot(0.01, 10.0 * 0.001))  # at 10 m/s, ± 1 ms
    assert tagged.vertical_sigma_m == pytest.approx(0.015)
    assert tagged.gnss is not None
    assert tagged.gnss.fix_type == 6
    assert (tagged.source, first.tag.time_source) == ("mark", TimeSource.LOGGED_MARK)


@pytest.mark.parametrize(("off_s", "found"), [(0.06, [0, 1, 2, 3, 4, 5]), (0.1, [0, 1, 3, 4, 5])])
def test_a_shot_has_its_mark_within_four_of_its_sigmas(tmp_path: Path, off_s: float, found: list[int]) -> None:
    """Its tag's sigma is 20 ms."""
    lines = [line(at_s + (off_s if index == 2 else 0.0)) for index, at_s in enumerate(TIMES_S)]
    assert sorted(find(fly(tmp_path), lines).marks) == found


def test_lost_and_extra_marks_are_named_and_lost_frames_keep_their_place(tmp_path: Path) -> None:
    flight = fly(tmp_path)
    times = [-29.9871, *TIMES_S[:3], *TIMES_S[4:]]  # a press on the ground before; that of frame 3 was not heard
    found = find(flight, [line(at_s, quality=2 if at_s == TIMES_S[2] else 1) for at_s in times])
    assert sorted(found.marks) == [0, 1, 2, 4, 5]
    assert found.lost == (3,)
    (extra,) = found.extra
    assert (extra.code, extra.facts["at"]) == (Code.MARK_OF_NO_SHOT, "10:14:33.012 UTC")
    assert [str(text(one)) for one in found.doubts] == ["1 mark of 5 not fixed: 4 (frame 2, float)"]
    placed, _ = geotags.read(flight, geotags.PlacedBy(Mounting(), GEOID, found))
    assert placed[3].tag.pose.source == "interpolated"


def test_a_flight_without_utc_is_matched_by_intervals_and_says_so(tmp_path: Path) -> None:
    flight = fly(tmp_path, utc_known=False)
    found = find(flight, [line(at_s + 3000.0) for at_s in TIMES_S])
    assert sorted(found.marks) == list(range(6))
    assert found.offset_s == pytest.approx(-2999.98, abs=1e-3)
    assert found.doubts[0].code is Code.MARKS_UNTIMED


def test_even_intervals_that_fit_twice_are_refused(tmp_path: Path) -> None:
    flight = fly(tmp_path, times_s=[2.0 * n for n in range(8)])
    with pytest.raises(DappledError, match="neither their times nor count"):
        find(flight, [line(2.0 * n + 900.0137) for n in range(7)])
    assert len(find(flight, [line(2.0 * n + 900.0137) for n in range(8)]).marks) == 8


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([line(at_s - 3 * 86400) for at_s in TIMES_S], "of 2026-11-18, the flight of 2026-11-21"),
        ([line(at_s, north_m=3000.0) for at_s in TIMES_S], "lie 3,000 m from where the autopilot was"),
        ([line(0.2 * n) for n in range(60)], "the whole track"),
        ([line(1.0 * n) for n in range(12)], "the whole track"),
        ([line(at_s * 1.3) for at_s in TIMES_S], "neither their times nor count"),
    ],
)
def test_marks_of_another_flight_are_refused(lines: list[str], says: str, tmp_path: Path) -> None:
    with pytest.raises(DappledError, match=says):
        find(fly(tmp_path), lines)


def test_heights_that_are_off_by_a_geoid_are_doubted(tmp_path: Path) -> None:
    found = find(fly(tmp_path), [line(at_s, up_m=30.2) for at_s in TIMES_S])
    assert found.doubts[0].code is Code.MARKS_HEIGHTS_DIFFER
    assert found.doubts[0].facts["up_m"] == pytest.approx(30.2, abs=0.05)


def test_doubts_of_the_marks_decide_the_exit_code(tmp_path: Path) -> None:
    path = pos(tmp_path, HEAD + "".join(line(at_s, up_m=30.2) for at_s in TIMES_S))
    call = ["geotag", str(fly(tmp_path)), "--pos", str(path), "--geoid", "-30", "-o", str(tmp_path / "out")]
    assert main(call) == 1
    assert (tmp_path / "out" / "geo.txt").exists()
    assert main([*call, "--anyway"]) == 0


def test_the_command_writes_marks_and_leaves_the_ledger(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    flight = fly(tmp_path)
    path = pos(tmp_path, HEAD + "".join(line(at_s) for at_s in TIMES_S[1:]))
    with LedgerReader.open(FlightFolder(flight).ledger) as ledger:
        before = ledger.digests("tags")
    assert main(["geotag", str(flight), "--pos", str(path), "--geoid", "-30", "-o", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().err
    assert "5 frames placed by a mark" in said
    assert "frame 0 has no mark" in said
    with LedgerReader.open(FlightFolder(flight).ledger) as ledger:
        assert ledger.digests("tags") == before
    features = json.loads((tmp_path / "out" / "track.geojson").read_text())["features"]
    assert [one["properties"].get("pose_source") for one in features] == [None, "interpolated", *["mark"] * 5]
    text = (tmp_path / "out" / "geo.txt").read_text().splitlines()
    assert text[2].split()[7:] == ["0.014", "0.015"]
    assert main(["geotag", str(flight), "--pos", str(tmp_path / "none.pos"), "-o", str(tmp_path / "other")]) == 2
    assert not (tmp_path / "other").exists()


def test_a_mark_far_from_the_others_is_left_out_and_named(tmp_path: Path) -> None:
    lines = [line(at_s, north_m=300.0 if n == 1 else NORTH_M, up_m=40.0 if n == 4 else UP_M) for n, at_s in
             enumerate(TIMES_S)]  # fmt: skip
    found = find(fly(tmp_path), lines)
    assert sorted(found.marks) == [0, 2, 3, 5]
    assert found.lost == (1, 4)
    assert [(one.subject.which, one.facts["frame"]) for one in found.doubts] == [(2, 1), (5, 4)]


def test_a_contact_that_bounces_counts_once(tmp_path: Path) -> None:
    found = find(fly(tmp_path), [line(at_s) for at_s in sorted([*TIMES_S, TIMES_S[2] + 0.01])])
    assert sorted(found.marks) == list(range(6))
    assert [str(told(one)) for one in found.extra] == ["mark 4: it is 10 ms after mark 3: it was left out"]


def test_what_is_told_of_thousands_of_marks_is_a_few_lines(tmp_path: Path) -> None:
    """A contact that trembles gave a line for each, and so did each frame without a mark."""
    marked = replace(find(fly(tmp_path), [line(at_s) for at_s in TIMES_S]), lost=tuple(range(3000)))
    extra = [finding(Code.MARK_BOUNCED, Subject("mark", n), after_ms=1.0, before=1) for n in range(2, 3002)]
    lines = marks.sentences(replace(marked, extra=(*extra, finding(Code.MARK_OF_NO_FRAME, Subject("mark", 1), shot=7))))
    assert len(lines) < 25
    assert lines.count("… and 2992 more") == 2
    assert lines[-1] == "mark 1: it is of shot 7, which left no frame"


def test_the_marks_antenna_has_a_lever_arm_of_its_own(tmp_path: Path) -> None:
    flight = fly(tmp_path)
    path = pos(tmp_path, HEAD + "".join(line(at_s) for at_s in TIMES_S[1:]))
    arms = Mounting(lever_m=(0.5, 0.0, 0.1))
    one = marks.find(flight, path, GEOID)
    other = marks.find(flight, path, GEOID, (0.3, 0.0, -0.2))  # 0.3 m nearer to the nose, and higher
    (lost, here), (same, there) = (
        geotags.read(flight, geotags.PlacedBy(arms, GEOID, found))[0][:2] for found in (one, other)
    )
    assert lost.camera == same.camera
    assert here.camera is not None
    assert there.camera is not None
    east = metres_per_radian(0.7266, 215.0)[1] * math.radians(there.camera.longitude_deg - here.camera.longitude_deg)
    assert east == pytest.approx(-0.3, abs=1e-3)
    assert there.camera.altitude_msl_m - here.camera.altitude_msl_m == pytest.approx(-0.2, abs=1e-3)


@pytest.mark.parametrize(("rate_hz", "utc_known"), [(1.0, True), (2.0, False), (5.0, True), (5.0, False)])
def test_no_shot_ever_gets_another_ones_mark(rate_hz: float, utc_known: bool) -> None:
    """Even and uneven flights with lost and extra marks, and one shot whose time is hardly known: right, or refused."""
    rng = np.random.default_rng(round(rate_hz))
    refused = 0
    for trial in range(12):
        n = 40
        begins = np.arange(n) / rate_hz + rng.uniform(0, 0.3 / rate_hz, n) * (trial % 3)
        own = begins + 0.013 + rng.normal(0, 0.0005, n)
        lost = set(rng.choice(n, trial % 4, replace=False).tolist()) | ({n - 1} if trial % 5 == 0 else set())
        truth = {round(float(own[i]), 6): i for i in range(n) if i not in lost}
        more = [float(own[-1]) + 1 / rate_hz, float(own[0]) - 1.7 / rate_hz][: trial % 3]
        times = sorted([*truth, *(round(one, 6) for one in more)])
        clock_s = 0.0 if utc_known else -2345.678
        shots = [
            TimedShot(i, float(at) + clock_s + rng.normal(0, 0.008), 0.3 if i == 7 else 0.01)
            for i, at in enumerate(begins)
        ]
        found = pair(shots, times, utc_known=utc_known, most_s=9e4)
        refused += not found.certain
        if found.certain:
            assert all(truth.get(times[mark]) == shot for shot, mark in found.pairs), trial
            assert len(found.pairs) >= len(truth) - 2
    assert refused <= (0 if utc_known and rate_hz < 5 else 10)


@pytest.mark.parametrize(("interval_s", "off_s", "its_own"), [(0.2, 0.06, True), (0.2, 0.11, False), (10.0, 0.5, True)])
def test_a_mark_that_is_nearer_to_the_next_shot_is_not_its_own(interval_s: float, off_s: float, its_own: bool) -> None:
    """Shot 7's time is hardly known: up to 0.4 of the interval, and no more, says which mark is its own."""
    begins = np.arange(20) * interval_s
    marks = [float(at) + off_s * (i == 7) for i, at in enumerate(begins)]
    shots = [TimedShot(i, float(at), 0.3 if i == 7 else 0.002) for i, at in enumerate(begins)]
    found = pair(shots, marks, utc_known=True, most_s=10.0)
    assert set(found.pairs) == {(i, i) for i in range(20) if i != 7 or its_own}


def test_a_covariance_keeps_its_axes() -> None:
    turn = camera_pose.ned_to_ecef(0.6, 2.4)
    ned = np.diag([1.0, 4.0, 9.0])
    ecef = turn @ ned @ turn.T
    values = {
        name: str(math.copysign(math.sqrt(abs(one)), one))
        for name, one in zip(
            ("sdx", "sdy", "sdz", "sdxy", "sdyz", "sdzx"),
            (*np.diag(ecef), ecef[0, 1], ecef[1, 2], ecef[2, 0]),
            strict=True,
        )
    }
    found = pos_file._covariance(values, "x", "y", "z")
    assert found is not None
    assert turn.T @ found @ turn == pytest.approx(ned, abs=1e-12)
