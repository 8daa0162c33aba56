"""What strangers and senders may write into the telemetry log: a rate for each sender and message."""

from __future__ import annotations

import itertools
from pathlib import Path

from dappled.drivers.mavlink import mavlink, pack
from dappled.drivers.mavlink.log_budget import LogBudget
from dappled.drivers.mavlink.signing import SignatureGuard, SigningTime
from tests.drivers.mavlink.test_signing import KEY, Clock, judged

S = 10**9


def written(budget: LogBudget, a_second: int, seconds: int, *, senders: int = 1, messages: int = 1) -> int:
    """Bytes of 100-byte packets that come evenly from all these."""
    mixed = itertools.cycle(itertools.product(range(senders), range(messages)))
    count = 0
    for at in range(a_second * seconds):
        sender, message = next(mixed)
        count += budget.takes((sender % 250, sender // 250), message, 100, at * S // a_second)
    return 100 * count


def test_an_autopilots_telemetry_is_written_whole() -> None:
    assert written(LogBudget(), 900, 5, messages=30) == 900 * 5 * 100  # 90 kB/s: all that a port at 921 600 baud brings


def test_a_flood_of_one_message_is_written_at_a_rate() -> None:
    assert written(LogBudget(), 5000, 10) <= 12 * 32_000


def test_a_flood_of_many_senders_and_messages_keeps_within_the_links_rate() -> None:
    assert written(LogBudget(), 20_000, 5, senders=1000, messages=1) <= 7 * (128_000 + 16 * 4_000 + 1_000)


def test_where_anybody_may_send_all_but_one_autopilot_have_less_than_a_megabyte_a_minute() -> None:
    budget = LogBudget(anybody=True)
    of_autopilot = of_others = 0
    for at in range(60_000):
        now_ns = at * S // 1000
        of_autopilot += budget.takes((1, 1), 30 + at % 30, 90, now_ns, "10.0.0.1:14550")
        for number in range(3):
            one = 3 * at + number
            of_others += budget.takes((one % 16 + 1, 1 + one % 2), one // 16 % 64, 280, now_ns, "10.0.0.66:5")
    assert of_autopilot == 60_000
    assert 280 * of_others <= 1_000_000


def test_who_sends_little_is_written_while_others_flood() -> None:
    budget = LogBudget()
    assert budget.takes((1, 1), 33, 40, 0)
    for at in range(5000):
        budget.takes((at % 250, 7), at % 200, 280, at * S // 5000)
        if at % 100 == 0:  # 50 a second
            assert budget.takes((1, 1), 33, 40, at * S // 5000)


def test_a_stranger_who_says_that_he_is_the_radio_is_heard_five_times_a_second(tmp_path: Path) -> None:
    clock = Clock()
    guard = SignatureGuard(KEY, 0, SigningTime(tmp_path / "time", clock))
    packer = mavlink.MAVLink(None, srcSystem=51, srcComponent=68)
    heard = 0
    for _ in range(5000):
        raw = pack(mavlink.MAVLink_radio_status_message(1, 1, 1, 1, 1, 1, 1), packer, version_1=False)
        if guard.sift(raw).sound:
            heard += judged(guard, raw) == "hear"
        clock.ns += S // 500
    assert 50 <= heard <= 60
    assert guard.statistics().unsigned_refused == 5000 - heard
