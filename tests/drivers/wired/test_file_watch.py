"""Files of shots that come in flight and later, from folders and cards that change."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import pytest

from dappled.clock import RecordedClock
from dappled.drivers.attribution import Claim
from dappled.drivers.camera import Blob, CameraError, Noticed
from dappled.drivers.wired import sources
from dappled.drivers.wired.file_watch import FileWatch
from dappled.drivers.wired.sources import FolderSource, FoundFile
from dappled.findings import Code
from dappled.picture_order import by_name

T0_S = 1_700_000_000
FILE_S = 30.0


class Picture(NamedTuple):
    """One that the body made: its number, for which shot (None: by hand), when, and the body's time of it."""

    number: int
    shot: int | None
    at_s: float
    taken_s: float | None

    @property
    def data(self) -> bytes:
        return f"picture {self.number:6d}".encode()


@dataclass(slots=True)
class Card:
    """What lies on a card or in a folder, as a FileSource. Files of all pictures have one size, as RAFs have."""

    removable: bool = True
    volume: str = ""
    there: bool = True
    files: dict[str, tuple[Picture, int]] = field(default_factory=dict)

    def list(self) -> list[FoundFile]:
        if not self.there:
            raise CameraError("no card is mounted")
        found = [FoundFile(name, len(one.data), ns, self.volume) for name, (one, ns) in self.files.items()]
        return by_name(found, lambda one: one.name)

    def taken_s(self, found: FoundFile) -> float | None:
        return self._of(found).taken_s

    def open(self, found: FoundFile) -> Blob:
        return Blob.of(self._of(found).data)

    def _of(self, found: FoundFile) -> Picture:
        if not self.there or found.name not in self.files:
            raise CameraError("it is gone")
        return self.files[found.name][0]

    def close(self) -> None: ...


class Watched:
    """A FileWatch of a source, whose looks the test asks for."""

    def __init__(self, source: sources.FileSource, *, in_flight: bool) -> None:
        self.clock = RecordedClock(T0_S * 10**9, T0_S * 10**9)
        self.watch = FileWatch(source, self.clock, in_flight=in_flight, file_s=FILE_S, pair_s=1.0)
        self.codes: list[Code] = []
        self.look()

    def fire(self, shot: int, at_s: float) -> None:
        self.clock.advance_to(round((T0_S + at_s) * 1e9))
        self.watch.expect(Claim(shot, self.clock.monotonic_ns()))

    def look(self, times: int = 1) -> list[tuple[int | None, bytes, str]]:
        """Look so often: the shot, the bytes and the doubt of each file that came."""
        came = []
        for _ in range(times):
            for event in self.watch.look():
                if isinstance(event, Noticed):
                    self.codes.append(event.finding.code)
                    continue
                came.append((event.shot, event.blob.map()[:], str(event.facts.get("doubt", ""))))
                event.blob.close()
        return came


def on_card(card: Card, number: int, picture: Picture) -> None:
    card.files[f"100_FUJI/DSCF{number:04d}.RAF"] = picture, round(picture.at_s / 2) * 2 * 10**9


def brought(shots: Sequence[int], pictures: Sequence[Picture]) -> list[tuple[int | None, bytes, str]]:
    return [(shot, one.data, "") for shot, one in zip(shots, pictures, strict=True)]


@pytest.mark.parametrize("volumes", [("", ""), ("0000-0001", "0000-0002"), ("", "0000-0002")])
@pytest.mark.parametrize("same_times", [False, True])
def test_a_card_changed_in_flight_brings_its_files_and_is_told(volumes: tuple[str, str], same_times: bool) -> None:
    card = Card(volume=volumes[0])
    watched = Watched(card, in_flight=False)
    pictures = [Picture(n, n, at_s, T0_S + at_s + 3600) for n, at_s in enumerate((3.0, 10.0, 22.0, 60.0, 66.0, 81.0))]
    for shot in (0, 1, 2):
        watched.fire(shot, pictures[shot].at_s)
        on_card(card, 1 + shot, pictures[shot])
    assert watched.look(3) == brought([0, 1, 2], pictures[:3])
    card.there = False
    watched.look()
    first, card.files, card.volume = card.files, {}, volumes[1]
    for shot in (3, 4, 5):
        watched.fire(shot, pictures[shot].at_s)
        on_card(card, shot - 2, pictures[shot])
    if same_times:  # names, sizes and even the times of the directory are the same
        card.files = {name: (one, first[name][1]) for name, (one, _) in card.files.items()}
    card.there = True
    assert watched.look(3) == brought([3, 4, 5], pictures[3:])
    assert watched.codes == [Code.CARD_CHANGED]
    assert watched.look(3) == []
    assert list(watched.watch.left()) == []


def test_a_picture_by_hand_before_the_first_shot_leaves_its_frame_in_doubt() -> None:
    card = Card(removable=False)
    watched = Watched(card, in_flight=True)
    hand, own = Picture(0, None, 9.9, T0_S + 3609.9), Picture(1, 0, 10.4, T0_S + 3612.4)
    watched.fire(0, 10.0)
    on_card(card, 1, hand)
    watched.clock.advance(0.5)
    assert watched.look(3) == [(0, hand.data, "")]
    watched.clock.advance(2.0)
    on_card(card, 2, own)
    assert watched.look(3) == [(None, own.data, "")]
    assert watched.codes == [Code.FRAME_RIVAL_PICTURE]


def test_the_card_that_was_read_last_and_comes_back_brings_nothing_again() -> None:
    card = Card()
    watched = Watched(card, in_flight=False)
    one, other = Picture(0, 0, 3.0, T0_S + 3), Picture(1, 1, 13.0, T0_S + 13)
    for shot, picture in enumerate((one, other)):
        watched.fire(shot, picture.at_s)
        on_card(card, 1 + shot, picture)
        card.there = True
        assert watched.look(3) == brought([shot], [picture])
        card.there = False
        watched.look()
    assert watched.codes == []


def test_a_picture_by_hand_that_stays_on_the_card_is_named() -> None:
    card = Card()
    watched = Watched(card, in_flight=False)
    one = Picture(0, 0, 3.0, T0_S + 3)
    watched.fire(0, 3.0)
    on_card(card, 1, one)
    assert watched.look(3) == brought([0], [one])
    on_card(card, 2, Picture(1, None, 20.0, T0_S + 20))
    assert watched.look(3) == []
    (left,) = watched.watch.left()
    assert (left.finding.code, left.finding.subject.which) == (Code.PICTURE_ON_CARD, "100_FUJI/DSCF0002.RAF")


def test_a_card_that_can_t_be_listed_at_the_end_is_told_where_shots_lack_files() -> None:
    card = Card(there=False)
    watched = Watched(card, in_flight=False)
    assert list(watched.watch.left()) == []
    watched.fire(0, 3.0)
    watched.look()
    assert [one.finding.code for one in watched.watch.left()] == [Code.CARD_NOT_LISTED]


@pytest.mark.parametrize("in_flight", [True, False])
def test_a_picture_of_another_hour_is_not_the_next_shot_s(in_flight: bool) -> None:
    """Shots 0 to 3 have their files; then one comes whose own time is an hour before shot 4, and shot 4's is lost."""
    folder = Card(removable=not in_flight)
    watched = Watched(folder, in_flight=in_flight)
    for shot in range(4):
        picture = Picture(shot, shot, 10.0 * shot, T0_S + 10.0 * shot)
        watched.fire(shot, picture.at_s)
        on_card(folder, 1 + shot, picture)
        assert watched.look(3) == brought([shot], [picture])
    watched.fire(4, 40.0)
    old = Picture(4, None, 40.5, T0_S + 40.0 - 3600)
    on_card(folder, 5, old)
    assert watched.look(3) == ([(None, old.data, "")] if in_flight else [])


def test_files_that_come_at_once_are_attributed_in_the_order_in_which_they_were_taken() -> None:
    """The counter rolls over: DSCF0001 is the later one."""
    folder = Card(removable=False)
    watched = Watched(folder, in_flight=True)
    pictures = [Picture(n, n, 10.0 * n, None if n else T0_S) for n in range(4)]
    for shot, number in ((0, 9998), (1, 9999), (2, 1), (3, 2)):
        watched.fire(shot, 10.0 * shot)
        on_card(folder, number, pictures[shot])
    assert watched.look(2) == brought([0, 1, 2, 3], pictures)


def test_a_name_that_is_used_again_is_another_file_and_a_touched_one_is_not(tmp_path: Path) -> None:
    latest = tmp_path / "latest.npy"
    watched = Watched(FolderSource(tmp_path), in_flight=True)
    for shot, data in enumerate((b"first", b"other", b"a third one")):
        watched.fire(shot, 10.0 * shot)
        latest.write_bytes(data)
        os.utime(latest, ns=(0, (1 + shot) * 10**9))
        assert watched.look(3) == [(shot, data, "")]
        os.utime(latest, ns=(0, (1 + shot) * 10**9 + 10**8))
        assert watched.look(3) == []


def test_more_of_a_file_that_was_taken_too_early_is_a_second_file_of_its_shot(tmp_path: Path) -> None:
    slow = tmp_path / "slow.npy"
    watched = Watched(FolderSource(tmp_path), in_flight=True)
    watched.fire(0, 1.0)
    slow.write_bytes(b"one half")
    assert watched.look(3) == [(0, b"one half", "")]
    watched.fire(1, 11.0)
    slow.write_bytes(b"one half and the other")
    assert watched.look(3) == [(0, b"one half and the other", "")]
    (tmp_path / "next.npy").write_bytes(b"next")
    assert watched.look(3) == [(1, b"next", "")]


def test_a_folder_on_another_volume_is_another_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    volume = ["1234-ABCD"]
    monkeypatch.setattr(sources, "volume_id", lambda device: volume[0])
    watched = Watched(FolderSource(tmp_path), in_flight=True)
    for shot, name in enumerate(("1234-ABCD", "1234-ABCD", "5678-EF00")):
        volume[0] = name
        watched.fire(shot, 10.0 * shot)
        (tmp_path / f"{shot}.npy").write_bytes(b"%d on " % shot + name.encode())
        came = watched.look(3)
    assert came == [(2, b"2 on 5678-EF00", "")]  # those that were brought from the other volume are there, too
    assert watched.codes == [Code.CARD_CHANGED]
