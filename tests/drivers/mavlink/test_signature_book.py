"""Each signed packet is accepted once, on whichever link it comes; a wrong clock is named, and silences nobody else."""

from __future__ import annotations

from pathlib import Path

from dappled.drivers.mavlink.signature_book import COPY_NS, UNITS_PER_S
from dappled.drivers.mavlink.signing import SignatureGuard, SigningTime
from dappled.findings import Code, text
from tests.drivers.mavlink.test_signing import KEY, Clock, Peer, judged

S = 10**9


class Links:
    """Some links with one key, over one file of times; `Peer` has the right time when it begins."""

    def __init__(self, folder: Path, *, keys: tuple[bytes, ...] = (KEY, KEY), known: bool = False) -> None:
        self.folder, self.keys, self.known = folder, keys, known
        self.clock = Clock()
        self.start()

    def start(self) -> None:
        self.time = SigningTime(self.folder / "time", self.clock)
        self.guards = [SignatureGuard(key, number, self.time) for number, key in enumerate(self.keys)]
        if self.known:
            self.time.clock_known(0)

    def restart(self, *, orderly: bool = True) -> None:
        self.time.keep(ending=orderly)
        self.start()

    def judge(self, link: int, raw: bytes) -> str:
        return judged(self.guards[link], raw)

    def codes(self) -> list[tuple[Code, str | int]]:
        return [(one.code, one.subject.which) for one in self.time.findings()]


def test_what_was_recorded_on_one_link_is_refused_on_another(tmp_path: Path) -> None:
    links, station = Links(tmp_path), Peer()
    recorded = station.packet()
    assert links.judge(0, recorded) == "obey"
    links.clock.ns += COPY_NS + 1
    assert links.judge(1, recorded) == "refuse"
    assert links.guards[1].statistics().replayed == 1


def test_a_station_on_two_links_is_heard_on_both_and_obeyed_once(tmp_path: Path) -> None:
    """The slower link is 1 s behind, and each link loses some packets."""
    links, station = Links(tmp_path), Peer()
    packets = [station.packet() for _ in range(9)]
    assert [links.judge(0, raw) for raw in packets[:8] if raw is not packets[3]] == ["obey"] * 7
    links.clock.ns += S
    came = [links.judge(1, raw) for raw in packets[1:]]
    assert came == ["copy", "copy", "obey", "copy", "copy", "copy", "copy", "obey"]
    assert links.judge(0, packets[8]) == "copy"
    assert {links.judge(1, raw) for raw in packets[1:]} == {"refuse"}
    assert links.codes() == []


def test_keys_have_books_of_their_own(tmp_path: Path) -> None:
    other = bytes(reversed(KEY))
    links = Links(tmp_path, keys=(KEY, other))
    assert links.judge(0, Peer().packet()) == "obey"
    assert links.judge(1, Peer(other, offset_s=-30).packet()) == "obey"


def test_after_a_restart_each_stream_goes_on_where_it_was(tmp_path: Path) -> None:
    links, fast, slow = Links(tmp_path), Peer(system=255), Peer(system=254, offset_s=-30)
    fast_packet, slow_packet = fast.packet(), slow.packet()
    assert [links.judge(0, raw) for raw in (fast_packet, slow_packet)] == ["obey", "obey"]
    links.restart()
    assert [links.judge(1, raw) for raw in (fast_packet, slow_packet)] == ["refuse", "refuse"]
    assert [links.judge(0, one.packet()) for one in (fast, slow)] == ["obey", "obey"]


def test_crashes_one_after_another_keep_a_station_out_for_ten_seconds_in_all(tmp_path: Path) -> None:
    links, station = Links(tmp_path, known=True), Peer()
    assert links.judge(0, station.packet()) == "obey"
    for _ in range(10):
        links.restart(orderly=False)
    station.packer.signing.timestamp += 10 * UNITS_PER_S
    assert links.judge(0, station.packet()) == "obey"


def test_one_packet_from_the_future_keeps_nobody_out_once_this_machine_knows_the_time(tmp_path: Path) -> None:
    links = Links(tmp_path, known=True)
    early = Peer(system=255, offset_s=50 * 60)
    assert links.judge(0, early.packet()) == "obey"
    assert links.judge(0, Peer(system=254).packet()) == "obey"
    assert links.codes() == [(Code.LINK_CLOCK_AHEAD, "255/190")]
    links.restart()
    assert links.judge(0, Peer(system=253, offset_s=1).packet()) == "obey"
    assert links.judge(0, early.packet()) == "obey"


def test_the_time_is_asked_of_others_again_when_this_machine_learns_it(tmp_path: Path) -> None:
    """It began with the time of its last shutdown, an hour ago."""
    links = Links(tmp_path)
    links.clock.ns -= 3600 * S
    links.start()
    assert links.judge(0, Peer(system=255, offset_s=50 * 60).packet()) == "obey"
    assert links.judge(0, Peer(system=254).packet()) == "refuse"
    links.time.clock_known(3600 * S)
    assert links.judge(0, Peer(system=254).packet()) == "obey"


def test_a_sender_whose_clock_went_back_is_named_until_it_is_right(tmp_path: Path) -> None:
    links, autopilot = Links(tmp_path), Peer(system=1)
    assert links.judge(0, autopilot.packet()) == "obey"
    autopilot.packer.signing.timestamp -= 3600 * UNITS_PER_S
    assert [links.judge(0, autopilot.packet()) for _ in range(3)] == ["refuse"] * 3
    assert links.codes() == [(Code.LINK_CLOCK_BEHIND, "1/190")]
    said = str(text(next(iter(links.time.findings()))))
    assert "3599 s older" in said or "3600 s older" in said
    autopilot.packer.signing.timestamp += 3601 * UNITS_PER_S
    assert links.judge(0, autopilot.packet()) == "obey"
    assert links.codes() == []


def test_one_recorded_packet_sent_again_and_again_is_not_called_a_clock(tmp_path: Path) -> None:
    links, station = Links(tmp_path), Peer()
    recorded = station.packet()
    station.packer.signing.timestamp += 60 * UNITS_PER_S
    assert [links.judge(0, raw) for raw in (recorded, station.packet())] == ["obey", "obey"]
    links.clock.ns += 3 * S
    assert {links.judge(1, recorded) for _ in range(20)} == {"refuse"}
    assert links.codes() == []
