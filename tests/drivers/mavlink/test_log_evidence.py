"""What counts in an autopilot's own log: samples, receivers, cores and dates."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from PIL import Image

from dappled.cli import main
from dappled.decode.geometry import Pose, metres_per_radian, turn_rad
from dappled.drivers.mavlink import PacketParser, dataflash, mavlink, pack, ulog
from dappled.drivers.utc_choice import ROLLOVER_NS, UtcBounds
from dappled.findings import Code, Finding, Level, text
from dappled.flight.log_reading import split
from tests.drivers.mavlink.true_logs import BOOT_US, UTC_US, Row, poses, rewritten, same_fix, ulog_written, written

pytestmark = pytest.mark.usefixtures("logs_read_here")
NAN, POSITION = math.nan, 33
Change = Callable[[str, Row], Iterable[tuple[str, Row]]]
NOW_NS = UTC_US * 1000 + 3600 * 10**9


def found_in(log: Path, bounds: UtcBounds | None = None) -> list[Finding]:
    """What is said of a log."""
    told: list[Finding] = []
    reader = ulog if log.suffix == ".ulg" else dataflash
    assert list(reader.packets(log, told.append, bounds or UtcBounds.of_log(NOW_NS)))
    return told


@cache
def honest() -> tuple[Pose, ...]:
    """What is read from a log in which nothing is wrong."""
    with TemporaryDirectory() as folder:
        return tuple(poses(written(Path(folder))[0]))


def away_m(here: Pose, there: Pose) -> float:
    assert here.latitude_rad is not None
    assert there.latitude_rad is not None
    assert here.longitude_rad is not None
    assert there.longitude_rad is not None
    assert here.altitude_msl_m is not None
    assert there.altitude_msl_m is not None
    north, east = metres_per_radian(here.latitude_rad, 220.0)
    return math.hypot(
        (here.latitude_rad - there.latitude_rad) * north,
        (here.longitude_rad - there.longitude_rad) * east,
        here.altitude_msl_m - there.altitude_msl_m,
    )


def changed(log: Path, name: str, at: int, place: int, value: float, *, in_a_row: int = 1) -> Path:
    """The log with other values: of the messages `name` from number `at` on."""
    seen = 0

    def change(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
        nonlocal seen
        if kind == name and not (kind == "XKF1" and row[1]):
            if at <= seen < at + in_a_row:
                row = (*row[:place], value, *row[place + 1 :])
            seen += 1
        return [(kind, row)]

    return rewritten(log, change)


@pytest.mark.parametrize(  # at the exposures of `poses`, or just before
    "at", [25, *(pytest.param(at, marks=pytest.mark.slow) for at in (13, 37))]
)
@pytest.mark.parametrize(
    ("name", "place", "value"),
    [
        ("XKF1", 2, NAN), ("XKF1", 3, math.inf), ("XKF1", 2, 400.0), ("XKF1", 4, -1e30), ("XKF1", 3, -150.0),
        ("POS", 3, NAN), ("POS", 4, NAN), ("POS", 1, 950_000_000), ("POS", 2, 0), ("POS", 1, 416_500_000),
        ("POS", 3, 1e7), ("ATT", 2, NAN), ("ATT", 6, math.inf), ("POS", 0, 2**63 + 5), ("XKF1", 0, 2**64 - 1),
    ],
)  # fmt: skip
def test_one_bad_value_is_missing_at_its_time_and_counted(
    tmp_path: Path, name: str, place: int, value: float, at: int
) -> None:
    log, _ = written(tmp_path)
    told = found_in(changed(log, name, at, place, value))
    assert [(one.code, one.level) for one in told] == [(Code.LOG_VALUES_MISSING, Level.NOTE)]
    assert str(text(told[0])).endswith(f"1 of {name}")
    for here, there in zip(poses(log), honest(), strict=True):
        assert here.source == "interpolated"
        assert away_m(here, there) < 0.1
        assert here.attitude is not None
        assert there.attitude is not None
        assert turn_rad(here.attitude, there.attitude) < 0.02


@pytest.mark.parametrize(
    ("name", "place", "value", "in_a_row", "at"),
    [
        ("XKF1", 3, -150.0, 2, 0), ("XKF1", 2, 290.0, 3, 13), ("XKF1", 2, NAN, 2, 25), ("POS", 1, 416_500_000, 3, 0),
        ("POS", 2, 0, 2, 13), ("POS", 2, -1_799_000_000, 3, 25), ("POS", 3, 9e4, 3, 0), ("POS", 4, -5e3, 2, 25),
        ("ATT", 2, 179.0, 3, 13), ("ATT", 6, NAN, 2, 0), ("ATT", 2, 179.0, 2, 25),
    ],
)  # fmt: skip
def test_bad_values_in_a_row_are_missing_ones(
    tmp_path: Path, name: str, place: int, value: float, at: int, *, in_a_row: int
) -> None:
    log, _ = written(tmp_path)
    told = found_in(changed(log, name, at, place, value, in_a_row=in_a_row))
    assert [(one.code, one.level) for one in told] == [(Code.LOG_VALUES_MISSING, Level.NOTE)]
    assert str(text(told[0])).endswith(f"{in_a_row} of {name}")
    for here, there in zip(poses(log), honest(), strict=True):
        assert away_m(here, there) < 0.5
        assert here.attitude is not None
        assert there.attitude is not None
        assert turn_rad(here.attitude, there.attitude) < 0.1


@pytest.mark.parametrize("name", ["POS", "XKF1", "ATT", "GPS", "GPA"])
def test_no_value_of_a_log_breaks_its_reader(tmp_path: Path, name: str) -> None:
    """Values of any bits in 3 of 10 messages."""
    random = np.random.default_rng(5)
    widths = {"Q": 2**64, "L": 2**31, "e": 2**31, "B": 256, "H": 2**16, "C": 2**16, "c": 2**15, "I": 2**32}
    form = {"POS": "QLLfff", "XKF1": "QBfff", "ATT": "Qffffff", "GPS": "QBBIHBcLLe", "GPA": "QBCCCC"}[name]

    def change(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
        if kind != name or random.random() < 0.7:
            return [(kind, row)]
        place = int(random.integers(len(row)))
        code = form[place]
        value = random.choice([NAN, math.inf, 3e38, -1e10, 0.0]) if code == "f" else int(random.random() * widths[code])
        return [(kind, (*row[:place], value, *row[place + 1 :]))]

    log = rewritten(written(tmp_path)[0], change)
    assert any(raw[7] == POSITION for _, _, raw in dataflash.packets(log))


def with_receivers(first: tuple[int, ...], second: tuple[int, ...] | None, used: int | None = None) -> Change:
    """A change of records: receiver 1 says (status, week), and a second one that is fixed says another."""

    def change(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
        if kind == "GPA":
            return [(kind, (row[0], 0, 900, 900, 900, 900)), (kind, (row[0], 1, *row[2:]))]
        if kind != "GPS":
            return [(kind, row)]
        flags = ((), ()) if used is None else ((int(used == 0),), (int(used == 1),))
        rows = [(kind, (row[0], 0, first[0], row[3], first[1], *row[5:], *flags[0]))] if first else []
        return [*rows, *([(kind, (row[0], 1, *row[2:], *flags[1]))] if second else [])]

    return change


@pytest.mark.parametrize("first", [(1, 0), (2, 2445), ()])
@pytest.mark.parametrize("used", [None, 0, 1])
def test_the_receiver_that_has_a_fix_counts(tmp_path: Path, first: tuple[int, ...], used: int | None) -> None:
    log, link = written(tmp_path)
    rewritten(log, with_receivers(first, (6, 2445), used), "" if used is None else "U")
    told = found_in(log)
    assert [one.facts["receiver"] for one in told] == [2]
    for here, there in zip(poses(log), poses(link), strict=True):
        assert away_m(here, there) < 0.01
        assert same_fix(here, there)


@pytest.mark.parametrize("turn", [20, 40])
def test_receivers_that_have_a_fix_in_turn_count_in_turn(tmp_path: Path, turn: int) -> None:
    log, link = written(tmp_path)
    count = 0

    def change(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
        nonlocal count
        if kind == "GPA":
            return [(kind, row), (kind, (row[0], 1, *row[2:]))]
        if kind != "GPS":
            return [(kind, row)]
        count += 1
        dead = (1, 0, 0, *row[5:7], 0, 0, 0)
        first, second = (row[2:], dead) if count < turn else (dead, row[2:])
        return [(kind, (row[0], 0, *first)), (kind, (row[0], 1, *second))]

    found_in(rewritten(log, change))
    assert all(same_fix(here, there) for here, there in zip(poses(log), poses(link), strict=True))


def test_of_two_receivers_with_a_fix_the_one_in_use_counts(tmp_path: Path) -> None:
    log, link = written(tmp_path)
    rewritten(log, with_receivers((6, 2445), (6, 2445), 1), "U")
    assert [one.code for one in found_in(log)] == [Code.LOG_RECEIVER_USED]
    assert all(same_fix(here, there) for here, there in zip(poses(log), poses(link), strict=True))


@pytest.mark.parametrize("off_ms", [-37_000, 0, 18_000])
def test_a_receiver_whose_utc_contradicts_that_which_counts_is_told(tmp_path: Path, off_ms: int) -> None:
    """A 3D fix, heard first, beside one by RTK."""
    log, link = written(tmp_path)

    def change(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
        other = (row[0], 0, 3, row[3] + off_ms, *row[4:])
        return [(kind, other), (kind, (row[0], 1, *row[2:]))] if kind == "GPS" else [(kind, row)]

    told = found_in(rewritten(log, change))
    assert [(one.code, one.facts["receiver"]) for one in told] == [
        (Code.LOG_RECEIVER_BETTER, 2),
        *([(Code.TIME_RECEIVERS_DIFFER, 1)] if off_ms else []),
    ]
    assert all(away_m(here, there) < 0.01 for here, there in zip(poses(log), poses(link), strict=True))


@pytest.mark.parametrize("said", [True, False])
def test_the_core_that_flew_counts(tmp_path: Path, said: bool) -> None:
    """By XKF4, else by what agrees with the positions: the first core has gone astray."""
    log, link = written(tmp_path)

    def change(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
        if kind != "XKF1":
            return [(kind, row)]
        return [(kind, (row[0], 1 - row[1], *row[2:])), *([("XKF4", (row[0], 0, 1))] if said else [])]

    told = found_in(rewritten(log, change))
    assert [(one.code, one.facts["core"]) for one in told] == [(Code.LOG_CORE, 1)]
    assert all(away_m(here, there) < 0.01 for here, there in zip(poses(log), poses(link), strict=True))


def rolled(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
    return [(kind, (*row[:4], row[4] - 1024, *row[5:]) if kind == "GPS" else row)]


def test_a_week_that_rolled_over_is_mended_where_another_clock_agrees(tmp_path: Path) -> None:
    log = rewritten(written(tmp_path)[0], rolled)
    (doubt,) = found_in(log)
    assert (doubt.code, doubt.level) == (Code.TIME_WEEK_ROLLOVER, Level.CAUTION)
    near_ns = UTC_US * 1000 + 13 * 3600 * 10**9  # in another zone
    bounds = UtcBounds.of_log(NOW_NS, [near_ns])
    assert [one.code for one in found_in(log, bounds)] == [Code.TIME_WEEK_MENDED]
    stamps = [stamp_us for _, stamp_us, _ in dataflash.packets(log, bounds=bounds)]
    assert abs(stamps[0] - UTC_US) < 1000
    far = UtcBounds.of_log(NOW_NS, [near_ns - 5 * 86400 * 10**9])  # a clock that was never set tells nothing
    assert [one.code for one in found_in(log, far)] == [Code.TIME_WEEK_ROLLOVER]
    stamps = [stamp_us for _, stamp_us, _ in dataflash.packets(log, bounds=far)]
    assert abs(stamps[0] - UTC_US + ROLLOVER_NS // 1000) < 5 * 10**6  # by the leap seconds since


def test_a_week_that_rolled_over_costs_replay_its_good_face(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = rewritten(written(tmp_path)[0], rolled)
    frames = tmp_path / "frames"
    frames.mkdir()
    Image.new("RGB", (16, 16)).save(frames / "1.jpg")
    assert main(["replay", str(frames), "--telemetry", str(log)]) == 1
    assert "1024 weeks later would be 2026-11-21" in capsys.readouterr().err
    assert main(["replay", str(frames), "--telemetry", str(log), "--anyway"]) == 0
    exif = Image.Exif()
    exif[306] = "2026:11:21 05:15:04"
    Image.new("RGB", (16, 16)).save(frames / "1.jpg", exif=exif)
    capsys.readouterr()
    assert main(["replay", str(frames), "--telemetry", str(log), "--json"]) == 0
    shown = capsys.readouterr()
    assert '"arrived_utc_ns": 1795256103' in shown.out
    assert "as another clock says" in shown.err


@pytest.mark.parametrize("form", ["bin", "tlog"])
@pytest.mark.parametrize(("interval_s", "code"), [(1, 0), (9, 1)])
def test_a_log_that_was_cut_short_is_in_doubt_where_frames_need_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str, interval_s: int, code: int
) -> None:
    log = written(tmp_path)[form == "tlog"]
    log.write_bytes(log.read_bytes()[:-3])
    (tmp_path / "frames").mkdir()
    for name in ("1.jpg", "2.jpg"):
        Image.new("RGB", (16, 16)).save(tmp_path / "frames" / name)
    call = ["replay", str(tmp_path / "frames"), "--telemetry", str(log), "--interval", str(interval_s)]
    assert main(call) == code
    said = capsys.readouterr().err
    if form == "bin" or code:  # of a link's log no more is read than the frames need
        assert f"{'in doubt' if code else 'note'}: log {log}: " in said
    assert main([*call, "--anyway"]) == 0


@pytest.mark.parametrize(
    ("change", "start_s", "interval_s", "said"),
    [
        (lambda kind, row: [(kind, (*row[:4], NAN) if kind == "XKF1" else row)], 1.0, 3, "2 frames got no position"),
        (lambda kind, row: [(kind, row)], 3600.0, 3, "2 frames got no position"),
        (lambda kind, row: [(kind, row)], 4.5, 60, "1 frame got no position"),
        (lambda kind, row: [(kind, row)], 1.0, 3, ""),
    ],
)
def test_frames_that_a_log_gives_no_position_are_in_doubt(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: Change, start_s: float, *, interval_s: int, said: str
) -> None:
    log = rewritten(written(tmp_path)[0], change)
    (tmp_path / "frames").mkdir()
    for name in ("1.jpg", "2.jpg"):
        Image.new("RGB", (16, 16)).save(tmp_path / "frames" / name)
    start = datetime.fromtimestamp(UTC_US / 1e6 + start_s, UTC).isoformat()
    call = ["replay", str(tmp_path / "frames"), "--telemetry", str(log), "--start", start]
    assert main([*call, "--interval", str(interval_s)]) == bool(said)
    assert said in (shown := capsys.readouterr().err)
    assert ("in doubt" in shown) == bool(said)


@pytest.mark.parametrize("form", ["bin", "tlog"])
def test_a_position_that_contradicts_its_velocity_is_told_beside_the_frames_near_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], form: str
) -> None:
    """One position is 40 m off: less than a vehicle may have moved since the one before."""
    log, link = written(tmp_path)
    if form == "bin":
        count = 0

        def change(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
            nonlocal count
            count += kind == "POS"
            return [(kind, (row[0], row[1] + 3600 * (count == 13), *row[2:]) if kind == "POS" else row)]

        rewritten(log, change)
    else:
        parts, count, log = [], 0, link
        for stamp_us, raw in split(link.read_bytes()):
            message = PacketParser()(raw)
            if message is not None and message.get_type() == "GLOBAL_POSITION_INT":
                count += 1
                message.lat += 3600 * (count == 13)
                packer = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
                parts.append(struct.pack(">Q", stamp_us) + pack(message, packer, version_1=False))
            else:
                parts.append(struct.pack(">Q", stamp_us) + raw)
        link.write_bytes(b"".join(parts))
    (tmp_path / "frames").mkdir()
    Image.new("RGB", (16, 16)).save(tmp_path / "frames" / "1.jpg")
    start = datetime.fromtimestamp(UTC_US / 1e6 + 1.25, UTC).isoformat()
    assert main(["replay", str(tmp_path / "frames"), "--telemetry", str(log), "--start", start]) == 1
    assert "jumped by" in capsys.readouterr().err


@pytest.mark.parametrize(("start_s", "code"), [(1.0, 0), (2.5, 1)])
def test_a_hole_in_a_tlog_is_in_doubt_where_a_frame_lies_in_it(tmp_path: Path, start_s: float, code: int) -> None:
    _, link = written(tmp_path)
    data = bytearray(link.read_bytes())
    stamps_us = [stamp_us for stamp_us, _ in split(bytes(data))]
    begin, end = (data.find((stamps_us[0] + at_us).to_bytes(8, "big")) for at_us in (2_000_000, 3_000_000))
    assert 0 < begin < end
    data[begin:end] = bytes(end - begin)
    link.write_bytes(data)
    (tmp_path / "frames").mkdir()
    Image.new("RGB", (16, 16)).save(tmp_path / "frames" / "1.jpg")
    start = datetime.fromtimestamp(stamps_us[0] / 1e6 + start_s, UTC).isoformat()
    assert main(["replay", str(tmp_path / "frames"), "--telemetry", str(link), "--start", start]) == code


def test_the_leap_seconds_are_those_of_the_flight(tmp_path: Path) -> None:
    """16 in May 2015, 17 a year later; and on the day that the leap second came, in the middle of a week of GPS."""

    def in_week(week: int, later_ms: int = 0) -> int:
        def change(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
            return [(kind, (*row[:3], row[3] - later_ms, week, *row[5:]) if kind == "GPS" else row)]

        packets = dataflash.packets(rewritten(written(tmp_path)[0], change))
        return next(stamp_us for _, stamp_us, _ in packets) // 10**6

    assert (in_week(1894) - in_week(1844)) % (7 * 86400) == 7 * 86400 - 1
    assert in_week(1851) - in_week(1851, 5 * 86_400_000) == 5 * 86400 - 1  # Saturday and Monday, July 2015


UNIX_US = 1_790_000_000 * 10**6
WRAP_US = 2**32 * 1000 - BOOT_US  # MAVLink's milliseconds since boot have 32 bits: 49.7 days


@pytest.mark.parametrize(("blended", "on_for_us"), [(True, 0), (False, UNIX_US), (True, WRAP_US - 3_000_000)])
def test_px4_logs_whose_utc_or_stamps_stand_elsewhere_give_the_same_poses(
    tmp_path: Path, blended: bool, on_for_us: int
) -> None:
    pytest.importorskip("pyulog", reason="pyulog is part of the extra ground")
    plain = poses(ulog_written(tmp_path))
    log = ulog_written(tmp_path, blended=blended, on_for_us=on_for_us)
    assert next(iter(ulog.packets(log)))[1] == UTC_US
    for here, there in zip(poses(log), plain, strict=True):
        assert here.source == "interpolated"
        assert away_m(here, there) < 0.01
        assert same_fix(here, there)


@pytest.mark.parametrize("wraps", [1, 407])
@pytest.mark.parametrize("before_us", [1_000_000, 5_500_000])
def test_a_log_of_ardupilot_may_pass_32_bits_of_milliseconds(tmp_path: Path, wraps: int, before_us: int) -> None:
    later_us = wraps * 2**32 * 1000 - BOOT_US - before_us
    log, link = written(tmp_path)
    rewritten(log, lambda kind, row: [(kind, (row[0] + later_us, *row[1:]))])
    assert found_in(log) == []
    for here, there in zip(poses(log), poses(link), strict=True):
        assert here.source == "interpolated"
        assert away_m(here, there) < 0.01
        assert same_fix(here, there)


def in_weeks(weeks: Callable[[int], int]) -> Change:
    """A change of records: GPS message n is `weeks(n)` weeks too early."""
    count = 0

    def change(kind: str, row: Row) -> Iterable[tuple[str, Row]]:
        nonlocal count
        if kind != "GPS":
            return [(kind, row)]
        count += 1
        return [(kind, (*row[:4], row[4] - weeks(count), *row[5:]))]

    return change


@pytest.mark.parametrize(
    ("weeks", "code", "off_weeks"),
    [
        (lambda n: 0 if n < 4 else 1024, Code.TIME_WEEK_MENDED, 0),  # it knew first, or knows later
        (lambda n: 1024 if n < 40 else 0, Code.TIME_WEEK_MENDED, 0),
        (lambda n: 500 if n == 7 else 1024, Code.TIME_WEEK_ROLLOVER, 1024),  # a damaged message, whose date is possible
        (lambda n: 2048, Code.TIME_WEEK_ROLLOVER, 2048),  # the ten bits as they are sent
        (lambda n: 2048 if n < 40 else 0, Code.TIME_WEEK_MENDED, 0),
    ],
)
def test_what_most_dates_say_counts(tmp_path: Path, weeks: Callable[[int], int], code: Code, off_weeks: int) -> None:
    log = rewritten(written(tmp_path)[0], in_weeks(weeks))
    (told,) = found_in(log)
    assert told.code is code
    stamps = [stamp_us for _, stamp_us, _ in dataflash.packets(log, bounds=UtcBounds.of_log(NOW_NS))]
    assert abs(stamps[0] - UTC_US + off_weeks * 7 * 86400 * 10**6) < 20 * 10**6


def test_two_rollovers_are_mended_where_another_clock_agrees(tmp_path: Path) -> None:
    log = rewritten(written(tmp_path)[0], in_weeks(lambda n: 2048))
    bounds = UtcBounds.of_log(NOW_NS, [UTC_US * 1000])
    (told,) = found_in(log, bounds)
    assert (told.code, told.facts["weeks"]) == (Code.TIME_WEEK_MENDED, 2048)
    assert abs(next(dataflash.packets(log, bounds=bounds))[1] - UTC_US) < 1000


REPORTS = {
    "df-gps1-dead.bin": Code.LOG_RECEIVER_BETTER,
    "df-gps1-2d.bin": Code.LOG_RECEIVER_BETTER,
    "df-only-gps-instance1.bin": Code.LOG_RECEIVER_BETTER,
    "df-week-rollover.bin": Code.TIME_WEEK_ROLLOVER,
    "df-xkf1-nan-once.bin": Code.LOG_VALUES_MISSING,
    "df-pos-alt-nan-once.bin": Code.LOG_VALUES_MISSING,
    "df-xkf1-fast-once.bin": Code.LOG_VALUES_MISSING,
    "px4-blended-utc0.ulg": None,
}


@pytest.mark.parametrize("name", REPORTS)
def test_the_logs_of_reports_give_the_poses_of_their_plain_twin(shared_data: Path, name: str) -> None:
    log = shared_data / "reports" / name
    mended = UtcBounds.of_log(NOW_NS)
    assert [one.code for one in found_in(log, mended)] == [code for code in [REPORTS[name]] if code]
    if name != "df-week-rollover.bin":
        plain = poses(shared_data / "reports" / "df-plain.bin")
        assert max(away_m(here, there) for here, there in zip(poses(log), plain, strict=True)) < 0.02


def test_a_log_whose_stamps_are_unix_time_gives_positions(shared_data: Path) -> None:
    pytest.importorskip("pyulog", reason="pyulog is part of the extra ground")
    log = shared_data / "telemetry" / "pyulog-sample_px4_events.ulg"
    assert not [one for one in found_in(log) if one.level > Level.NOTE]
    stamps = [stamp_us for _, stamp_us, _ in ulog.packets(log)]
    assert 1_710_773_350 <= stamps[0] // 10**6 <= stamps[-1] // 10**6 <= 1_710_773_382
