"""Names of files by their content."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.drivers.attribution import (
    true_name,
)


def tiff(order: str, *tags: int) -> bytes:
    mark = {"<": b"II*\0", ">": b"MM\0*"}[order]
    rows = b"".join(struct.pack(order + "HHII", tag, 1, 4, 0) for tag in tags)
    return mark + struct.pack(order + "IH", 8, len(tags)) + rows + b"\0" * 4


@pytest.mark.parametrize(
    ("name", "head", "true"),
    [
        ("capt0000.cr2", tiff("<", 256, 50706), "capt0000.dng"),
        ("capt0000.cr2", tiff(">", 256, 50706), "capt0000.dng"),
        ("capt0000.cr2", tiff("<", 256, 257), "capt0000.cr2"),
        ("IMG_0001.DNG", tiff("<", 256, 50706), "IMG_0001.DNG"),
        ("IMG_0001.CR2", tiff("<", 50706), "IMG_0001.DNG"),
        ("capt0000.jpg", b"II*\0\x10\0\0\0CR\x02\0" + b"\0" * 20, "capt0000.cr2"),
        ("capt0000.cr2", b"\xff\xd8\xff\xe0", "capt0000.jpg"),
        ("capt0000.jpg", b"FUJIFILMCCD-RAW 0201", "capt0000.raf"),
        ("capt0000.nef", b"nobody knows", "capt0000.nef"),
        ("noname", b"\xff\xd8\xff\xe0", "noname"),
    ],
)
def test_the_bytes_decide_the_extension(name: str, head: bytes, true: str) -> None:
    assert true_name(name, head) == true


@given(st.sampled_from([b"", b"II*\0", b"MM\0*"]), st.binary(max_size=64))
def test_any_bytes_are_handled(mark: bytes, rest: bytes) -> None:
    assert true_name("a.cr2", mark + rest).startswith("a.")


@pytest.mark.parametrize("name", ["synthetic_450D.CR2", "synthetic_S5200.RAF", "real_Canon_EOS_450D.jpg"])
def test_real_files_keep_their_names(shared_data: Path, name: str) -> None:
    with (shared_data / "raw" / name).open("rb") as file:
        assert true_name(name, file.read(65536)) == name
