"""A pipe, a device without end, and a file of holes in the place of a file: one sentence at once, at every door."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from dappled.bounds import arrays, parsing
from dappled.config import profiles, settings
from dappled.daemon.stream import curve
from dappled.decode.geometry import area
from dappled.drivers.mavlink import dataflash
from dappled.drivers.raw import reading
from dappled.errors import DappledError
from dappled.products import opened
from dappled.products.exports import mask_files
from dappled.products.geotags import pos_file, sidecars
from dappled.products.maps import ground

DOORS: dict[str, Callable[[Path], object]] = {
    "a.cr2": reading.read,
    "a.lfp": reading.read,
    "a.npy": reading.read,
    "a.npz": opened.light_field,
    "b.npz": lambda path: arrays.read_npz(path, ["a"]),
    "a.h5": opened.light_field,
    "a.png": mask_files.read,
    "a.tif": ground.check,
    "a.kml": area.read,
    "a.pos": pos_file.read,
    "a.bin": lambda path: list(dataflash.packets(path)),
    "a.toml": settings.load,
    "mask.toml": lambda path: profiles.mask(str(path)),
    "a.key": curve.load_public,
    "a.xmp": lambda path: sidecars.write(path, "content"),
    "a.json": parsing.read_bytes,
}


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def holes(path: Path) -> None:
    path.touch()
    os.truncate(path, 1 << 40)


@pytest.mark.parametrize("make", [pipe, device, holes])
@pytest.mark.parametrize("name", DOORS)
def test_what_is_no_plain_file_is_neither_waited_for_nor_read(
    tmp_path: Path, name: str, make: Callable[[Path], None]
) -> None:
    path = tmp_path / name
    make(path)
    with pytest.raises((OSError, ValueError, DappledError)) as refused:
        DOORS[name](path)
    said = str(refused.value)
    assert "plain file" in said or "its content would take" in said or "longer than" in said, said


@pytest.mark.parametrize("full", [True, False])
def test_a_large_file_that_has_no_blocks_yet_is_read_and_one_of_holes_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, full: bool
) -> None:
    """ZFS tells a file's blocks seconds after it was written."""
    path, piece, told = tmp_path / "a.bin", os.urandom(4 << 20), os.fstat
    with path.open("wb") as file:
        for _ in range(66):
            file.write(piece) if full else file.seek(len(piece), os.SEEK_CUR)
        file.write(b"end")

    def without_blocks(fd: int) -> os.stat_result:
        values = tuple(told(fd))
        return os.stat_result(values, {"st_blocks": 1})

    monkeypatch.setattr(os, "fstat", without_blocks)
    try:
        if full:
            assert parsing.stored_size(path) == 66 * len(piece) + 3
        else:
            with pytest.raises(OSError, match="it has holes"):
                parsing.stored_size(path)
    finally:
        path.unlink()
