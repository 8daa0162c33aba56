"""Calibrate a lens from pictures of a chessboard: distance, principal point, distortion, and their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.config.profiles import Lens
from dappled.decode.array_types import Floats
from dappled.decode.optics import Sensor
from dappled.errors import DappledError
from dappled.products.extras import need
from dappled.products.maps import eye

LEAST_BOARDS = 5
_WORST_V = 0.02  # relative σ of v that is still a calibration
_LEAST_SPREAD = math.radians(20)  # between the boards' directions
_SMALL_PX, _MIDDLE_PX = 480, 800  # longest sides of the reduced pictures
_UNITS = 1000.0  # micrometres: OpenCV expects numbers of the size of pixels


@dataclass(frozen=True, slots=True)
class LensFit:
    """A fitted lens: `residual_um` is rms on the chip, `v_sigma_mm` one standard deviation."""

    lens: Lens
    residual_um: float
    v_sigma_mm: float
    boards: int


def corners(image: NDArray[np.floating], board: tuple[int, int]) -> Floats | None:
    """(columns · rows, 2) pixels (x, y) of a board's inner corners, row by row; None where it isn't seen completely.

    `board` counts inner corners: (columns, rows). The board is searched for in reduced pictures first, where the noise,
    the fine detail and the mask's pattern of a full one are averaged: these make the search ten to a thousand times
    longer. Its corners are refined in the full picture.
    """
    cv2 = need("cv2")
    full = np.ascontiguousarray(image, dtype=np.float32)
    rough = _search(full, board)
    if rough is None:
        return None
    square = min(np.linalg.norm(np.diff(rough, axis=axis), axis=2).min() for axis in (0, 1))
    reach = max(2, round(float(square) / 4))
    even = cv2.GaussianBlur(full, (0, 0), max(0.5, float(square) / 20))  # noise and mask, not the corners, go with it
    sharp = cv2.cornerSubPix(even, rough.reshape(-1, 1, 2), (reach, reach), (-1, -1), (3, 50, 1e-4))
    return np.asarray(sharp, dtype=np.float64).reshape(-1, 2)


def _search(full: NDArray[np.float32], board: tuple[int, int]) -> NDArray[np.float32] | None:
    """(rows, columns, 2) rough corners (x, y) in pixels of the full picture; None where no whole board is found."""
    cv2 = need("cv2")
    by_squares, by_symmetry = cv2.findChessboardCorners, cv2.findChessboardCornersSB
    # Each finds boards that the other misses, `by_squares` takes seconds in large pictures that show no board to it.
    for find, side in (
        (by_squares, _SMALL_PX),
        (by_symmetry, _SMALL_PX),
        (by_symmetry, _MIDDLE_PX),
        (by_symmetry, max(full.shape)),
        (by_squares, _MIDDLE_PX),
    ):
        share = min(1.0, side / max(full.shape))
        size = round(full.shape[1] * share), round(full.shape[0] * share)
        picture = full if share == 1 else cv2.resize(full, size, interpolation=cv2.INTER_AREA)
        low, high = np.percentile(picture, (1, 99))
        eight = np.round(255 * np.clip((picture - low) / max(high - low, 1e-12), 0, 1)).astype(np.uint8)
        seen, found = find(eight, board)
        if seen:
            steps = np.array([full.shape[1] / size[0], full.shape[0] / size[1]])
            there = (np.asarray(found, dtype=np.float64).reshape(board[1], board[0], 2) + 0.5) * steps - 0.5
            return np.asarray(there, dtype=np.float32)
    return None


def fit(
    seen: Sequence[Floats], grids: Sequence[Floats], *, board: tuple[int, int], sensor: Sensor, focal_length_mm: float
) -> LensFit:
    """Fit the lens to corners (n, 2) in pixels of views, each with its `grid` to the sensor, as in `LightField`.

    Raises DappledError where there are too few boards, or they leave the lens' distance uncertain.
    """
    if len(seen) < LEAST_BOARDS:
        raise DappledError(
            f"the board of {board[0]} × {board[1]} inner corners was found in {len(seen)} pictures, {LEAST_BOARDS} are "
            "needed: count its inner corners for --board, and show it whole and sharp"
        )
    cv2 = need("cv2")
    size_mm = sensor.size_mm
    middle = np.array([size_mm[1] / 2, size_mm[0] / 2])
    flat = np.zeros((board[0] * board[1], 3), np.float32)
    flat[:, :2] = np.stack(np.meshgrid(np.arange(board[0]), np.arange(board[1])), axis=-1).reshape(-1, 2)
    on_chip = [
        ((eye.on_chip_mm(pixels, sensor, grid) + middle) * _UNITS).astype(np.float32)
        for pixels, grid in zip(seen, grids, strict=True)
    ]
    guess = np.array(
        [
            [focal_length_mm * _UNITS, 0, middle[0] * _UNITS],
            [0, focal_length_mm * _UNITS, middle[1] * _UNITS],
            [0, 0, 1],
        ]
    )
    size = tuple(math.ceil(side * _UNITS) for side in (size_mm[1], size_mm[0]))
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO | cv2.CALIB_FIX_K3
    residual, matrix, bends, turns, _, sigmas, _, _ = cv2.calibrateCameraExtended(
        [flat] * len(seen), on_chip, size, guess, np.zeros(5), flags=flags
    )
    v_mm, v_sigma_mm = float(matrix[1, 1]) / _UNITS, float(max(sigmas[0, 0], sigmas[1, 0])) / _UNITS
    normals = np.array([eye.turn(np.asarray(one, np.float64).ravel())[:, 2] for one in turns])
    spread = math.acos(float(np.clip((normals @ normals.T).min(), -1, 1)))
    if not (math.isfinite(v_mm) and 0 < v_sigma_mm < _WORST_V * v_mm and spread > _LEAST_SPREAD):
        raise DappledError(
            f"these pictures leave the lens' distance uncertain ({v_mm:.1f} ± {v_sigma_mm:.1f} mm): "
            "tilt the board by 20 to 40° both ways in some of them, and fill the frame"
        )
    principal = (float(matrix[1, 2] / _UNITS - middle[1]), float(matrix[0, 2] / _UNITS - middle[0]))
    k1, k2, p1, p2, k3 = (float(number) for number in np.asarray(bends).ravel()[:5])
    return LensFit(Lens(focal_length_mm, v_mm, principal, (k1, k2, p1, p2, k3)), float(residual), v_sigma_mm, len(seen))
