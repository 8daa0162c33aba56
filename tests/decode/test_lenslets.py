from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dappled.decode.errors import DecodeError
from dappled.decode.lenslets import LensletDecoder
from dappled.decode.spectrum.plane import to_plane

PITCH = 10.4
SHAPE = (420, 500)


def _frame(slope: float, *, vignette: bool = True) -> np.ndarray:
    """Square lenslets; the light grows by `slope` a pixel of column under each lenslet, and falls off at its edge."""
    y, x = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(float)
    under = [(axis - 2.2) / PITCH - np.round((axis - 2.2) / PITCH) for axis in (y, x)]
    light = 0.4 + 0.1 * np.cos(2 * np.pi * (0.012 * y + 0.007 * x)) + slope * under[1] * PITCH
    fall = np.exp(-((under[0] ** 2 + under[1] ** 2) / 0.18)) if vignette else 1.0
    return np.asarray(light * fall, dtype=np.float32)


def test_a_larger_u_reaches_pixels_of_larger_column() -> None:
    white = _frame(0.0)
    field, report = LensletDecoder.with_white(white).decode_reported(_frame(0.02))
    assert report.carriers_from == "calibrated"
    assert field.attributes["lenslet_pitch_px"] == pytest.approx([PITCH, PITCH], abs=0.01)
    n = field.views.shape[0]
    assert n == field.views.shape[1] == 9
    means = field.views[:, :, 5:-5, 5:-5].mean(axis=(2, 3))
    middle = means[n // 2, n // 2 - 2 : n // 2 + 3]
    step = PITCH / n * 0.02 / 0.4  # over the white frame's views, whose scene is the same
    assert np.diff(middle / middle[2]) == pytest.approx([step] * 4, rel=0.25)  # a sawtooth's Fourier sum overshoots
    assert np.ptp(means[n // 2 - 2 : n // 2 + 3, n // 2]) < 0.02 * means[n // 2, n // 2]
    assert field.view_offsets[0, -1] == pytest.approx((-4 / 9, 4 / 9))


def test_without_a_white_frame_the_lattice_and_its_origin_are_the_frames_own() -> None:
    field, report = LensletDecoder(SHAPE).decode_reported(_frame(0.0), focal_length_mm=35.0)
    assert (report.carriers_from, report.views_from) == ("found", "frame")
    means = field.views.mean(axis=(2, 3))
    brightest = np.unravel_index(np.argmax(means), means.shape)
    assert brightest == (means.shape[0] // 2, means.shape[1] // 2)
    assert field.attributes["focal_length_mm"] == 35.0


def test_a_frame_of_another_size_or_without_lenslets_is_refused() -> None:
    with pytest.raises(DecodeError, match="made for"):
        LensletDecoder(SHAPE).decode(_frame(0.0)[:200])
    with pytest.raises(DecodeError):
        LensletDecoder(SHAPE).decode(np.random.default_rng(0).normal(0.5, 0.1, SHAPE).astype(np.float32))


def test_letters_with_their_white_frame(shared_data: Path) -> None:
    folder = shared_data / "lenslet/ulf_letters"
    frame, white, dark = (
        np.asarray(Image.open(folder / f"letters_ULF_M1{end}.png")) for end in ("", "_white", "_dark")
    )
    decoder = LensletDecoder.with_white(to_plane(white, black=0, white=255))
    field, report = decoder.decode_reported(to_plane(frame, black=0, white=255, dark=dark))
    assert field.views.shape[:2] == (15, 15)
    assert report.found > 50
    assert np.isfinite(field.views).all()
