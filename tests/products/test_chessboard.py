"""The lens found from a chessboard, against the lens that drew it."""

from __future__ import annotations

import functools
import math
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from dappled.cli import main
from dappled.config import profiles
from dappled.config.profiles import Lens
from dappled.decode.optics.carriers import Sensor
from dappled.errors import DappledError
from dappled.products import chessboard
from dappled.products.maps import eye

SENSOR = Sensor((694, 922), (0.02, 0.0), (0.0, 0.02))  # half the reference camera's inner half, in every direction
TRUE = Lens(50.0, 51.3, (0.11, -0.16), (-0.35, 1.5, 0.002, -0.003, 0.0))
GRID = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
BOARD = (9, 6)
TILTS = ((0, 0), (0.5, 0), (-0.5, 0.1), (0, 0.55), (0.1, -0.5), (0.4, 0.4), (-0.4, -0.4))


@functools.cache
def rays_of(lens: Lens) -> NDArray[np.float64]:
    """(pixels, 3): where each pixel looks."""
    rows, columns = SENSOR.shape
    matrix = eye.intrinsics(SENSOR, lens, GRID)
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).reshape(-1, 2).astype(float)
    flat = (pixels - matrix[:2, 2]) @ np.linalg.inv(matrix[:2, :2]).T
    return np.concatenate([eye.undistorted(flat, lens.distortion), np.ones((len(pixels), 1))], axis=1)


def drawn(tilt: tuple[float, float], lens: Lens = TRUE, aside: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """A board of 9 × 6 inner corners, one unit a square, as this lens shows it, edges a pixel wide."""
    rows, columns = SENSOR.shape
    rays = rays_of(lens)
    turn = eye.turn(np.array([tilt[0], tilt[1], 0.1]))
    middle = np.array([*aside, 45.0])
    depth = (turn[:, 2] @ middle) / (rays @ turn[:, 2])
    on_board = (rays * depth[:, None] - middle) @ turn[:, :2] + [(BOARD[0] + 1) / 2, (BOARD[1] + 1) / 2]
    width = 45.0 * 0.02 / 50.0  # of a pixel, in squares
    wave = np.sin(np.pi * on_board).prod(axis=1)
    edge = np.clip(wave / (np.pi * width), -1, 1)
    inside = ((on_board > 0) & (on_board < [BOARD[0] + 1, BOARD[1] + 1])).all(axis=1)
    return np.asarray(np.where(inside, 0.5 - 0.4 * edge, 0.9).reshape(rows, columns))


@pytest.fixture(scope="module")
def pictures() -> list[NDArray[np.float64]]:
    rng = np.random.default_rng(2)
    return [drawn(tilt, aside=(0.3 * k - 1, 0.2 * k - 0.5)) + 0.005 * rng.standard_normal(SENSOR.shape)
            for k, tilt in enumerate(TILTS)]  # fmt: skip


def test_the_lens_that_drew_the_boards_is_found(pictures: list[NDArray[np.float64]]) -> None:
    seen = [found for picture in pictures if (found := chessboard.corners(picture, BOARD)) is not None]
    assert len(seen) == len(pictures)
    fit = chessboard.fit(seen, [GRID] * len(seen), board=BOARD, sensor=SENSOR, focal_length_mm=50.0)
    assert fit.lens.v_mm == pytest.approx(TRUE.v_mm, abs=4 * fit.v_sigma_mm)
    assert fit.v_sigma_mm < 0.15
    assert fit.residual_um < 2.0  # a tenth of a pixel
    # what maps need: where a ray falls, over the whole chip
    edge = np.array([[-0.12, -0.08], [0.12, 0.08], [0.1, -0.09], [0.0, 0.0], [-0.06, 0.05]])

    def falls(lens: Lens) -> NDArray[np.float64]:
        matrix = eye.intrinsics(SENSOR, lens, GRID)
        return np.asarray(eye.distorted(edge, lens.distortion) @ matrix[:2, :2].T + matrix[:2, 2])

    off = falls(fit.lens) - falls(TRUE)
    # a shift of the principal point and a small turn of the camera can't be told apart on few boards
    assert np.abs(off - off.mean(axis=0)).max() < 0.5
    assert np.abs(falls(Lens(50.0, 50.0)) - falls(TRUE)).max() > 10


def test_boards_seen_flat_on_are_refused() -> None:
    found = chessboard.corners(drawn((0, 0.0), aside=(-1.0, 0.0)), BOARD)
    assert found is not None
    kept = [found + np.array([20.0 * k, 0.0]) for k in range(5)]
    with pytest.raises(DappledError, match="tilt the board"):
        chessboard.fit(kept, [GRID] * 5, board=BOARD, sensor=SENSOR, focal_length_mm=50.0)
    with pytest.raises(DappledError, match="found in 2 pictures"):
        chessboard.fit(kept[:2], [GRID] * 2, board=BOARD, sensor=SENSOR, focal_length_mm=50.0)


def test_a_picture_without_a_board_shows_none() -> None:
    assert chessboard.corners(np.random.default_rng(1).random((300, 400)), BOARD) is None


def test_the_command_keeps_the_lens_in_a_profile(
    pictures: list[NDArray[np.float64]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera = tmp_path / "mine.toml"
    camera.write_text(
        "law = 'geometric'\nmask_distance_mm = 0.48\n[[raw]]\nname = 'small'\nshape = [694, 922]\n"
        "row_mm = [0.02, 0.0]\ncolumn_mm = [0.0, 0.02]\n"
    )
    frames = []
    for number, picture in enumerate(
        [*pictures, np.linspace(0.2, 0.8, SENSOR.shape[0] * SENSOR.shape[1]).reshape(SENSOR.shape)]
    ):
        frames.append(str(tmp_path / f"{number}.png"))
        Image.fromarray(np.round(65535 * np.clip(picture, 0, 1)).astype(np.uint16)).save(frames[-1])
    output = tmp_path / "calibrated.toml"
    words = ["calibrate", "--lens", *frames, "--camera", str(camera), "-o", str(output)]
    assert main(words) == 1
    assert "--focal-length" in capsys.readouterr().err
    assert main([*words, "--focal-length", "50"]) == 0
    said = capsys.readouterr()
    assert "7 boards" in said.out
    assert "no whole board in" in said.err
    lens = profiles.camera(str(output)).lens(50.2)
    assert lens is not None
    assert lens.v_mm == pytest.approx(TRUE.v_mm, rel=0.01)
    assert profiles.camera(str(output)).lens(35.0) is None
    with pytest.raises(SystemExit):
        main([*words, "--focal-length", "50", "--board", "nine", "--overwrite"])
    assert "--board: nine: give its inner corners" in capsys.readouterr().err
    assert math.isfinite(lens.distortion[0])


def _dim(picture: NDArray[np.float64], seed: int) -> NDArray[np.float64]:
    """The picture with little contrast, and as much noise as that."""
    return 0.4 + 0.02 * picture + 0.008 * np.random.default_rng(seed).standard_normal(picture.shape)


def test_a_board_of_as_much_noise_as_contrast_is_found(pictures: list[NDArray[np.float64]]) -> None:
    clear, dim = (chessboard.corners(one, BOARD) for one in (pictures[5], _dim(pictures[5], 3)))
    assert clear is not None
    assert dim is not None
    assert np.sqrt(np.mean((dim - clear) ** 2)) < 2.0


@pytest.mark.long
def test_eight_boards_of_two_megapixels_take_five_seconds_of_cpu(
    pictures: list[NDArray[np.float64]], tmp_path: Path
) -> None:
    camera = tmp_path / "mine.toml"
    camera.write_text(
        "law = 'geometric'\nmask_distance_mm = 0.48\n[[raw]]\nname = 'whole'\nshape = [1222, 1622]\n"
        "row_mm = [0.01136, 0.0]\ncolumn_mm = [0.0, 0.01137]\n"
    )
    frames = []
    for number, picture in enumerate([*pictures, pictures[0]]):
        large = np.asarray(Image.fromarray(picture.astype(np.float32)).resize((1622, 1222), Image.Resampling.BICUBIC))
        noisy = 0.4 + 0.02 * large + 0.003 * np.random.default_rng(number).standard_normal(large.shape)
        frames.append(str(tmp_path / f"{number}.png"))
        Image.fromarray(np.round(65535 * np.clip(noisy, 0, 1)).astype(np.uint16)).save(frames[-1])
    began = time.process_time()
    words = ["calibrate", "--lens", *frames, "--camera", str(camera), "--focal-length", "50", "-o"]
    assert main([*words, str(tmp_path / "lens.toml")]) == 0
    took = time.process_time() - began
    assert took < 5.0
    lens = profiles.camera(str(tmp_path / "lens.toml")).lens(50.0)
    assert lens is not None
    assert lens.v_mm == pytest.approx(TRUE.v_mm, rel=0.01)
