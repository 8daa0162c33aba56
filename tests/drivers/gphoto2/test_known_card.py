from __future__ import annotations

import pytest

from dappled.drivers.gphoto2.known_card import KnownCard
from dappled.drivers.gphoto2.protocol import CameraFile, CardContents

FOLDER = "/DCIM/100CANON"


def named(number: int, suffix: str = "CR2") -> CameraFile:
    return CameraFile(FOLDER, f"IMG_{number:04d}.{suffix}")


@pytest.mark.parametrize(
    ("names", "missed"),
    [
        ((9998, 9999, 1, 2), [True, False, False, False]),  # of the first it isn't known
        ((5, 7, 8), [True, True, False]),
        ((5, 4, 6), [True, False, False]),
        ((5, 500, 501), [True, False, False]),  # another row
        ((5, 5, 6), [True, False, False]),  # a raw file and its JPEG
    ],
)
def test_a_skipped_number_may_be_a_picture_that_was_missed(names: tuple[int, ...], missed: list[bool]) -> None:
    card = KnownCard(())
    assert [card.count(named(number)) for number in names] == missed


def test_the_shots_beside_a_file_are_those_next_to_it_by_the_camera_s_count() -> None:
    card = KnownCard(())
    for number, shot in ((9998, 1), (9999, 2), (2, 4)):
        card.made(named(number), shot, 100 + shot)
    assert card.neighbours(named(1), 103) == (2, 4)
    assert card.neighbours(named(1), None) == (2, 4)
    assert card.neighbours(named(3), 105) == (4, None)
    assert card.neighbours(named(3), 100) == (None, None)  # made before its forerunners: it counts anew
    assert card.neighbours(CameraFile("/", "capt0001.cr2"), 105) == (None, None)


@pytest.mark.parametrize(
    ("facts", "known"),
    [((9, 5000), True), ((9, 5000 + 7200), True), ((9, None), True), ((8, 5000), False), ((9, 5001), False)],
)
def test_a_file_is_known_by_size_and_time_in_any_zone(facts: tuple[int, int | None], known: bool) -> None:
    card = KnownCard([(FOLDER, "IMG_0001.CR2", 9, 5000, None)])
    assert card.has(named(1), facts) is known
    assert card.is_other(CardContents({named(1): facts}), has_old=False) is not known


def test_a_file_that_was_given_up_is_not_asked_for_again() -> None:
    card = KnownCard(())
    card.settle(named(1), None)
    found = CardContents({named(1): (7, 1)})
    assert card.has(named(1), (7, 1))
    assert not card.is_other(found, has_old=False)
    card.list(found, ())
    assert card.is_done(named(1))
    card.change()
    assert not card.has(named(1), (7, 1))
