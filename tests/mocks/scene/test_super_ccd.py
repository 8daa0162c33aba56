"""A digital S5200, and what Tables 12, 13, 15 and 16 may be: its processing, a pattern in the scene, or the mask.

Peaks are looked for at the tables' own places, as shares of the picture's sides: processing counts pixels, so a smaller
picture has its artefacts at the same shares.
"""

from __future__ import annotations

import io
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from dappled.decode.optics import Mask
from dappled.mocks.scene.ray_camera import WHITE, RayCamera
from dappled.mocks.scene.super_ccd import SuperCcdBody, interpolated, sampled

HIGH, WIDE = 2776, 3688
SHAPE = (240, 312)
PITCH_MM = (4.29 / HIGH, 5.76 / WIDE)
# The measured steps (rows, columns) in bins of the S5200's picture, and the focal length in mm (13 is captioned 33).
TABLES = {12: ((654.2, 614.5), 12.0), 13: ((184.3, 184.0), 40.0), 15: ((285.8, 282.5), 13.0), 16: ((695.0, 614.7), 6.0)}
# Steps of Mask 2's fundamental; Mask 4's (Tables 15 and 16) is half of it.
PLACES = {n: [(0.0, c / WIDE), (r / HIGH, 0.0), (r / HIGH, c / WIDE)] for n, ((r, c), _) in TABLES.items()}


def luma(body: SuperCcdBody, light: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) 0 to 1: what a program reads from the body's file, as the thesis did."""
    with Image.open(io.BytesIO(body.jpeg(light))) as picture:
        return np.asarray(picture, dtype=np.float32) / np.float32(255)


def power(picture: NDArray[np.floating], place: tuple[float, float]) -> float:
    """Power of a plane wave (cycles/pixel), Hann window."""
    down, across = (
        np.hanning(n) * np.exp(-2j * np.pi * f * np.arange(n)) for n, f in zip(picture.shape, place, strict=True)
    )
    return float(abs(down @ (picture - picture.mean()) @ across) ** 2)


def above(pictures: list[NDArray[np.floating]], place: tuple[float, float]) -> float:
    """How many times stronger a place is than those around it, 4 to 6 bins away, over several pictures."""
    around = [(dy / SHAPE[0], dx / SHAPE[1]) for dy in (-5, 0, 5) for dx in (-5, 0, 5) if (dy, dx) != (0, 0)]
    near = [power(p, (place[0] + dy, place[1] + dx)) for p in pictures for dy, dx in around]
    return float(np.sqrt(np.mean([power(p, place) for p in pictures]) / np.mean(near)))


def light(seed: int, contrast: float) -> NDArray[np.float32]:
    """Coloured scenes of detail at every scale, with a sensor's noise."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(SHAPE[0])[:, None], np.fft.rfftfreq(SHAPE[1])[None, :]
    size = np.maximum(np.hypot(fy, fx), 1 / SHAPE[1]) ** -1.2

    def texture() -> NDArray[np.float64]:
        made = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(SHAPE)) * size, s=SHAPE)
        return np.asarray(made / made.std())

    grey = texture()
    made = np.stack([c * (1 + contrast * (grey + 0.3 * texture())) for c in (0.42, 0.36, 0.28)], axis=-1)
    made += 0.005 * rng.standard_normal((*SHAPE, 1))
    return np.clip(made, 0.02, 1).astype(np.float32)


@cache
def processed(contrast: float) -> list[NDArray[np.float32]]:
    return [luma(SuperCcdBody(), light(seed, contrast)) for seed in range(8)]


def test_the_chip_has_every_second_place_and_as_much_green_as_red_and_blue() -> None:
    values, colour = sampled(np.full((8, 8), 0.5, dtype=np.float32))
    assert [(colour == c).sum() for c in (0, 1, 2, -1)] == [8, 16, 8, 32]
    assert "".join("RGB."[c] for c in colour[0]) == "B.R.B.R."
    assert "".join("RGB."[c] for c in colour[1]) == ".G.G.G.G"
    assert "".join("RGB."[c] for c in colour[2]) == "R.B.R.B."
    assert (values > 0).sum() == 32


def test_interpolation_keeps_what_is_smooth_in_every_colour() -> None:
    x = np.linspace(0.2, 0.6, 40, dtype=np.float32)
    ramp = np.stack([np.tile(x * s, (32, 1)) for s in (1.2, 1.0, 0.7)], axis=-1)
    assert np.abs(interpolated(ramp) - ramp)[6:-6, 6:-6].max() < 1e-3


def test_sharpening_raises_fine_detail_and_the_file_is_in_srgb() -> None:
    columns = 0.3 * (1 + 0.3 * np.cos(2 * np.pi * np.arange(64) / 6))
    grating = np.tile(columns, (48, 1)).astype(np.float32)
    soft, sharp = (luma(SuperCcdBody(s, 100), grating) for s in (0.0, 1.0))
    assert soft.mean() == pytest.approx(1.055 * 0.3 ** (1 / 2.4) - 0.055, abs=0.01)
    # a 3 × 3 blur keeps (1 + 2·cos(60°))/3 = 2/3 of it: sharpened, it is 1 + 1/3 times as strong
    gain = power(sharp, (0.0, 1 / 6)) / power(soft, (0.0, 1 / 6))
    assert gain**0.5 == pytest.approx(4 / 3, rel=0.05)


def test_processing_has_artefacts_of_its_own_and_they_are_seen() -> None:
    """The lattice shows at half of the sampling frequency, and at a quarter where its colours are not balanced."""
    unbalanced = [sampled(light(seed, 0.0))[0] for seed in range(4)]
    assert above(unbalanced, (0.25, 0.25)) > 20
    assert above(processed(0.25), (0.0, 0.5)) > 4
    assert above(processed(0.25), (0.5, 0.0)) > 4


@pytest.mark.parametrize("contrast", [0.0, 0.25])
@pytest.mark.parametrize("table", TABLES)
def test_no_step_of_the_processing_makes_the_peaks_of_the_tables(table: int, contrast: float) -> None:
    """Nor at W/6, W/3 and H/4, which are among them: everything is within twice of what stands around it."""
    for multiple in (1, 2):
        for fy, fx in PLACES[table]:
            if multiple * fy < 0.49:
                assert above(processed(contrast), (multiple * fy, multiple * fx)) < 2


@pytest.mark.parametrize("table", TABLES)
def test_a_pattern_in_the_scene_makes_the_columns_of_all_tables_at_their_focal_lengths(table: int) -> None:
    """1272 cycles a radian (a period of 0.79 mrad) and half of it: at f mm, 1272/f cycles/mm on the sensor."""
    (_, step), focal_mm = TABLES[table]
    cycles = (1272 if table in (12, 13) else 636) / focal_mm * PITCH_MM[1]
    assert cycles * WIDE == pytest.approx(step, abs=5)
    x = np.arange(SHAPE[1])
    scene = light(1, 0.2) * (1 + 0.1 * np.cos(2 * np.pi * cycles * x))[None, :, None].astype(np.float32)
    assert above([luma(SuperCcdBody(), scene)], (0.0, cycles)) > 8


def test_a_mask_before_the_sensor_makes_none_of_them() -> None:
    """Mask 2 at 1.01 mm, f/8, 13 mm: its orders stand at 10.5 cycles/mm and twice that, not at 49 and 67."""
    camera = RayCamera(
        Mask(11.38, 2, "diagonal", film_px_per_mm=113.8), shape=(160, 208), pitch_mm=PITCH_MM, boards=WHITE,
        focal_length_mm=13.0, f_number=8.0, mask_distance_mm=1.01, points_per_view=6, full_well_e=5000.0,
    )  # fmt: skip
    far = replace(camera, f_number=80.0)  # no lens does: it shows where the orders are
    pictures = [luma(SuperCcdBody(), replace(far, seed=seed).expose().plane) for seed in range(2)]
    ky, kx = camera.lattice().ky[0], camera.lattice().kx[1]
    assert above(pictures, (ky, kx)) > 8
    pictures = [luma(SuperCcdBody(), replace(camera, seed=seed).expose().plane) for seed in range(2)]
    for place in PLACES[15]:
        assert above(pictures, place) < 3
