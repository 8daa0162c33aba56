"""The raw file, as LibRaw sees it."""

from __future__ import annotations

import io
from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest
import rawpy
from hypothesis import given
from hypothesis import strategies as st

from dappled.mocks.scene import dng

EXIF = dng.Exif("dappled", "Simulated Masked Camera", "SIM7", 50.0, 7.4, 1 / 1000, 100, 1_781_517_600_900_000_000)


def test_libraw_reads_back_what_was_written() -> None:
    raw = np.random.default_rng(0).integers(0, 15361, (62, 94), dtype=np.uint16)
    with rawpy.imread(io.BytesIO(dng.encode(raw, black=1024, white=15360, exif=EXIF))) as seen:
        np.testing.assert_array_equal(seen.raw_image_visible, raw)
        assert seen.black_level_per_channel == [1024] * 4
        assert seen.white_level == 15360
        assert seen.raw_pattern is not None
        colours = [chr(seen.color_desc[i]) for i in seen.raw_pattern.ravel()]
        assert colours == ["R", "G", "G", "B"]
        assert seen.other.focal_length == 50.0
        assert seen.other.aperture == pytest.approx(7.4)
        assert seen.other.shutter_speed == pytest.approx(1 / 1000)
        assert seen.other.iso_speed == 100
        assert seen.other.timestamp == datetime(2026, 6, 15, 10, 0, 0)  # noqa: DTZ001  # EXIF has no zone


@given(
    focal=st.floats(4, 400), f_number=st.floats(1, 64), exposure=st.floats(1e-4, 30), iso=st.sampled_from([100, 6400])
)
def test_exif_survives_within_its_rounding(focal: float, f_number: float, exposure: float, iso: int) -> None:
    exif = replace(EXIF, focal_length_mm=focal, f_number=f_number, exposure_s=exposure, iso=iso)
    raw = np.full((32, 32), 2000, dtype=np.uint16)
    with rawpy.imread(io.BytesIO(dng.encode(raw, black=1024, white=15360, exif=exif))) as seen:
        assert seen.other.focal_length == pytest.approx(focal, abs=0.051)
        assert seen.other.aperture == pytest.approx(f_number, abs=0.0051)
        assert seen.other.shutter_speed == pytest.approx(exposure, rel=0.06)
        assert seen.other.iso_speed == iso


@pytest.mark.parametrize("shape", [(31, 32), (32, 33), (2, 32, 32)])
def test_a_plane_that_is_no_mosaic_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="two even sides"):
        dng.encode(np.zeros(shape, dtype=np.uint16), black=0, white=1, exif=EXIF)
