"""The one order of pictures, by time and by name."""

from __future__ import annotations

import pytest

from dappled.picture_order import by_name, by_time


@pytest.mark.parametrize(
    "ordered",
    [
        ["IMG_9998.CR2", "IMG_9998.JPG", "IMG_9999.CR2", "IMG_0001.CR2", "IMG_0002.CR2"],
        ["frame_1.png", "frame_2.png", "frame_10.png"],
        ["Frame_8.png", "frame_9.png", "FRAME_10.png"],
        ["frame_0001.png", "frame_0002.png", "frame_9999.png", "frame_10000.png"],
        ["IMG_0001.JPG", "IMG_5000.JPG", "IMG_9999.JPG"],
        ["DSC09999.ARW", "DSC00001.ARW"],
        ["DSCF9990.RAF", "DSCF0012.RAF"],
        ["100_FUJI/DSCF9999.RAF", "101_FUJI/DSCF0001.RAF"],
        ["999_FUJI/DSCF0001.RAF", "100_FUJI/DSCF0002.RAF"],
        ["a/2.png", "a/10.png", "b.png"],
        ["000002.cr2", "000010.cr2", "009999.cr2"],
        ["scene-2-view-9.png", "scene-2-view-10.png", "scene-10-view-1.png"],
        [],
    ],
)
def test_names_are_ordered_as_people_and_cameras_count(ordered: list[str]) -> None:
    assert by_name(reversed(ordered)) == ordered
    assert by_name(sorted(ordered)) == ordered


def test_time_comes_before_name_and_what_contradicts_it_is_named() -> None:
    taken = {"a2": 30.0, "a3": 10.0, "a4": None, "a10": 20.0, "a11": 20.0}
    found = by_time(sorted(taken), str, taken.get)
    assert found.items == ("a3", "a10", "a4", "a11", "a2")
    assert found.against == ("a2", "a3", 20.0)
    assert by_time(["b", "a"], str, {"a": 1.0, "b": 1.5}.get).against is None
    assert by_time(["b", "a"], str, {"b": 5.0}.get).items == ("a", "b")
