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
        ["dsc09999.arw", "dsc00001.arw"],
        ["DSC_9998.NEF", "DSC_9999.NEF", "DSC_0001.NEF"],
        ["_DSC9999.NEF", "_DSC0001.NEF"],
        ["_MG_9999.CR2", "_MG_0001.CR2"],
        ["1DX29998.CR3", "1DX29999.CR3", "1DX20001.CR3"],
        ["3N1A9999.CR3", "3N1A0001.CR3"],
        ["P1010999.ORF", "P1011000.ORF"],
        ["P1019999.RW2", "P1020001.RW2"],
        ["P1019999.ORF", "P1010001.ORF"],
        ["DJI_0998.DNG", "DJI_0999.DNG", "DJI_0001.DNG", "DJI_0003.DNG"],
        ["DJI_0001.DNG", "DJI_0999.DNG", "DJI_5000.DNG"],
        ["frame_0001.png", "frame_0999.png"],
        ["100MEDIA/DJI_0999.JPG", "101MEDIA/DJI_0001.JPG"],
        ["100CANON/IMG_0100.CR2", "101CANON/IMG_0101.CR2", "101CANON/IMG_0200.CR2", "102CANON/IMG_0201.CR2"],
        ["999CANON/IMG_9999.CR2", "100CANON/IMG_0001.CR2"],
        ["100ND750/DSC_9999.NEF", "101ND750/DSC_0001.NEF"],
        ["10060101/DSC09999.ARW", "10160102/DSC00001.ARW"],
        ["00009998.png", "00009999.png", "00010000.png"],
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
