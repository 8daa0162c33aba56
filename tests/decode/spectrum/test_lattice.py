from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PIL import Image

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum.lattice import FoundLattice, find_lattice, reduced
from dappled.decode.spectrum.plane import to_plane
from dappled.decode.spectrum.transform import transform


def pitch_px(found: FoundLattice) -> tuple[float, float]:
    """Distances between neighbouring rows of lenslets, 1/|(1, 0)| and 1/|(0, 1)|."""
    return 1 / math.hypot(*found.lattice.ky), 1 / math.hypot(*found.lattice.kx)


def _lenslets(steps: np.ndarray, shape: tuple[int, int], seed: int) -> np.ndarray:
    """A textured scene behind round lenslets whose centres are `steps` (rows: y, x in pixels) apart."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    orders = np.moveaxis(np.array([y + 3.3, x + 1.7]), 0, -1) @ np.linalg.inv(steps)
    distance = np.full(shape, np.inf)
    for a in (0, 1):
        for b in (0, 1):
            left = (orders - np.floor(orders) - (a, b)) @ steps
            distance = np.minimum(distance, np.hypot(left[..., 0], left[..., 1]))
    radius = 0.5 * min(np.hypot(*steps[0]), np.hypot(*steps[1]))
    scene = 0.5 + sum(
        0.05 * np.cos(2 * np.pi * (rng.normal(0, 0.01) * y + rng.normal(0, 0.01) * x) + rng.uniform(0, 6))
        for _ in range(12)
    )
    frame = scene * np.clip(radius + 0.5 - distance, 0, 1) + rng.normal(0, 0.01, shape)
    return np.asarray(frame, dtype=np.float32)


def _turned(steps: np.ndarray, degrees: float) -> np.ndarray:
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return np.asarray(steps @ np.array([[c, s], [-s, c]]))


@pytest.mark.parametrize(("pitch", "degrees"), [(9.3, 0.0), (9.3, -3.0), (17.7, 0.7)])
def test_square_lenslets_turned(pitch: float, degrees: float) -> None:
    frame = _lenslets(_turned(np.eye(2) * pitch, degrees), (420, 500), 1)
    found = find_lattice(transform(frame))
    assert pitch_px(found) == pytest.approx((pitch, pitch), abs=0.01)
    assert found.spacing_px == pytest.approx((pitch, pitch), abs=0.01)
    assert math.degrees(found.rotation_rad) == pytest.approx(degrees, abs=0.03)
    assert found.lattice.kx[1] > abs(found.lattice.kx[0])
    assert found.lattice.ky[0] > abs(found.lattice.ky[1])


@pytest.mark.parametrize("degrees", [0.05, 1.5])
def test_hexagonal_lenslets(degrees: float) -> None:
    steps = _turned(np.array([[10 * math.sqrt(3) / 2, 5.0], [0.0, 10.0]]), degrees)
    found = find_lattice(transform(_lenslets(steps, (420, 500), 2)))
    assert found.spacing_px == pytest.approx((10, 10), abs=0.01)
    assert pitch_px(found) == pytest.approx((8.660, 8.660), abs=0.01)
    area = abs(np.linalg.det(np.linalg.inv(found.lattice.matrix())))
    assert area == pytest.approx(100 * math.sqrt(3) / 2, rel=1e-3)


def _photograph(seed: int) -> np.ndarray:
    """1/f texture, edges, a fence: what a frame without a mask may hold."""
    rng = np.random.default_rng(seed)
    shape = (400, 520)
    fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :]
    spectrum = np.fft.rfft2(rng.normal(size=shape)) / np.maximum(np.hypot(fy, fx), 1 / 500)
    picture = np.fft.irfft2(spectrum, shape)
    picture = 0.4 + 0.1 * picture / picture.std()
    picture[150:260, 100:300] += 0.25
    picture[:, 380:] *= 0.5
    picture[300:360, ::17] *= 0.8
    return np.asarray(picture + rng.normal(0, 0.01, shape), dtype=np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_no_carriers_on_a_photograph(seed: int) -> None:
    with pytest.raises(DecodeError, match="no carriers"):
        find_lattice(transform(_photograph(seed)))


def test_no_carriers_in_noise_or_jpeg_blocks() -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(0.5, 0.1, (300, 360)).astype(np.float32)
    with pytest.raises(DecodeError):
        find_lattice(transform(noise))
    blocks = noise + 0.1 * (np.arange(360) % 8 == 0) + 0.1 * (np.arange(300) % 8 == 0)[:, None]
    with pytest.raises(DecodeError):
        find_lattice(transform(blocks.astype(np.float32)))


def test_reduction_finds_the_shortest_vectors() -> None:
    basis = reduced(np.array([[5.0, 1.0], [14.0, 3.0]]))
    assert abs(np.linalg.det(basis)) == pytest.approx(1.0)
    assert sorted(np.hypot(*basis.T)) == pytest.approx([1.0, 1.0])


def test_letters_photograph_alone(shared_data: Path) -> None:
    frame = np.asarray(Image.open(shared_data / "lenslet/ulf_letters/letters_ULF_M1.png"))
    found = find_lattice(transform(to_plane(frame, black=0, white=255)))
    assert pitch_px(found) == pytest.approx((48.23, 48.23), abs=0.02)


@pytest.mark.parametrize("name", ["light_field.tif", "radiometry_frame.tif"])
def test_sea_urchin_alone(shared_data: Path, name: str) -> None:
    frame = tifffile.imread(shared_data / "lenslet/lfm_seaurchin" / name)
    found = find_lattice(transform(to_plane(frame, black=0, white=255)))
    assert pitch_px(found) == pytest.approx((17.19, 17.19), abs=0.02)
    assert abs(math.degrees(found.rotation_rad)) == pytest.approx(0.18, abs=0.01)


def test_hexagonal_bayer_raw_alone(shared_data: Path) -> None:
    frame = np.asarray(Image.open(shared_data / "lenslet/lytro_like/raw.png"))
    plane = to_plane(frame, black=168, white=4095, cfa=np.array([[2, 1], [1, 0]]))
    found = find_lattice(transform(plane))
    assert found.spacing_px == pytest.approx((10, 10), abs=0.002)
    assert len(found.carriers) == found.predicted


@pytest.mark.parametrize("name", ["real_Canon_EOS_450D.jpg", "real_FujiFilm_FinePixS5500.jpg"])
def test_no_carriers_on_real_photographs(shared_data: Path, name: str) -> None:
    frame = np.asarray(Image.open(shared_data / "raw" / name).convert("L"))
    with pytest.raises(DecodeError):
        find_lattice(transform(to_plane(frame, black=0, white=255)))
