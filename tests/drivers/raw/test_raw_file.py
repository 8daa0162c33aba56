"""The exposure of a raw frame: histogram, clipped share, mean."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from dappled.drivers.raw.exposure_settings import ExposureSettings
from dappled.drivers.raw.raw_file import STEPS, RawFile, exposure, read_exif

WHITE, BLACK = 4095, 128


def raw(share: float, clipped_rows: int = 0, every_other: float | None = None) -> RawFile:
    """A frame of one linear value, with some rows at white; every other column has another value."""
    values = np.full((300, 400), BLACK + share * (WHITE - BLACK))
    if every_other is not None:
        values[:, 1::2] = BLACK + every_other * (WHITE - BLACK)
    values[:clipped_rows] = WHITE
    more = {"cfa": None, "colour_names": (), "balance": None}
    return RawFile.of(ExposureSettings(), np.round(values).astype(np.uint16), black=BLACK, white=WHITE, **more)


def test_a_value_stands_in_its_step() -> None:
    found = exposure(raw(0.25))
    assert sum(found.histogram) == pytest.approx(1)
    assert int(np.argmax(found.histogram)) in (STEPS // 2 - 1, STEPS // 2)  # √0.25 is the middle
    assert found.mean_share == pytest.approx(0.25, abs=1e-3)
    assert found.clipped_share == 0  # measured, and none: not the same as unknown


@pytest.mark.parametrize("rows", [30, 150, 300])
def test_the_clipped_share_is_counted(rows: int) -> None:
    found = exposure(raw(0.25, rows))
    assert found.clipped_share == pytest.approx(rows / 300, abs=0.02)
    assert found.histogram[-1] == pytest.approx(rows / 300, abs=0.02)


def test_one_colour_of_a_mosaic_that_is_clipped_is_seen() -> None:
    assert exposure(raw(0.2, every_other=1.0)).clipped_share == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("rows", [0, 150])
def test_the_black_share_is_counted(rows: int) -> None:
    dark = raw(0.25)
    dark.mosaic[:rows] = BLACK
    assert exposure(dark).black_share == pytest.approx(rows / 300, abs=0.02)


def maker_note(raw: int, *, begins: int = 662, tag: int = 4, count: int = 34) -> bytes:
    """A Canon maker note with ShotInfo alone, laid out by hand: a directory of one entry, its values, the footer."""
    values = [0] * count
    if count > 12:
        values[12] = raw
    entry = struct.pack("<HHII", tag, 3, count, begins + 18)
    return struct.pack("<H", 1) + entry + struct.pack("<I", 0) + struct.pack(f"<{count}h", *values) + b"II*\0" \
        + struct.pack("<I", begins)  # fmt: skip


def temperature_of(note: bytes) -> float | None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0x927C] = note
    file = io.BytesIO()
    Image.new("L", (8, 8)).save(file, "JPEG", exif=exif)
    file.seek(0)
    return read_exif(file).temperature_c


@pytest.mark.parametrize(
    ("raw", "degrees"), [(152, 24.0), (128, 0.0), (118, -10.0), (183, 55.0), (0, None), (-3, None)]
)
def test_a_canon_s_temperature_is_in_its_maker_note(raw: int, degrees: float | None) -> None:
    assert temperature_of(maker_note(raw)) == degrees


@pytest.mark.parametrize(
    "note",
    [maker_note(152, tag=1), maker_note(152, count=12), maker_note(152)[:-8], b"", b"FUJIFILM" + bytes(40)],
    ids=["no ShotInfo", "a short one", "no footer", "empty", "another maker's"],
)
def test_a_maker_note_without_one_has_none(note: bytes) -> None:
    assert temperature_of(note) is None


@given(st.binary(max_size=60), st.integers(0, 2**32 - 1))
def test_a_damaged_maker_note_costs_nothing(noise: bytes, begins: int) -> None:
    note = noise + b"II*\0" + struct.pack("<I", begins)
    found = temperature_of(note)
    assert found is None or -128 <= found < 128
