"""Two frames as a stereo pair: the ground has no parallax, a box moves sideways by its height, left is left."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.errors import DappledError
from dappled.products.survey import stereo_pair
from tests.products.survey import seen
from tests.products.survey.test_flight_sweep import BOX_M, box


def shift(a: NDArray[np.float32], b: NDArray[np.float32]) -> tuple[int, int]:
    """(rows, columns) by which `b` must be moved to lie on `a`, by correlation."""
    both = np.isfinite(a) & np.isfinite(b)
    spectra = [np.fft.fft2(np.where(both, picture - picture[both].mean(), 0)) for picture in (a, b)]
    found = np.unravel_index(np.argmax(np.fft.ifft2(spectra[0] * spectra[1].conj()).real), a.shape)
    return tuple((int(k) + side // 2) % side - side // 2 for k, side in zip(found, a.shape, strict=True))


def test_the_ground_lies_still_and_a_box_moves_sideways() -> None:
    """Flown north-east: the pair is turned so that the baseline is to the right."""
    flight = seen.flown([(-1.0, -1.0), (0.9, 0.9), (0.0, 0.0)], [(BOX_M, box, 300.0)], gsd_m=0.03)
    made = stereo_pair.pair(flight)
    assert made.names == ("000000", "000001")  # the longest baseline, the western one left
    assert made.baseline_m == pytest.approx(1.9 * np.sqrt(2), abs=0.01)
    assert made.share == pytest.approx(made.baseline_m / seen.HEIGHT_M, rel=0.01)
    left, right = made.eyes.left, made.eyes.right
    assert left.shape == right.shape
    rows, columns = left.shape
    edge = (slice(rows // 3, 2 * rows // 3), slice(columns // 6, columns // 6 + 90))
    assert shift(left[edge], right[edge]) == (0, 0)
    middle = (slice(rows // 2 - 25, rows // 2 + 25), slice(columns // 2 - 25, columns // 2 + 25))
    down, aside = shift(left[middle], right[middle])
    parallax = made.baseline_m * BOX_M / (seen.HEIGHT_M - BOX_M) / 0.03
    assert abs(down) <= 1
    assert aside == pytest.approx(parallax, abs=1.5)  # near things stand further right for the left eye


def test_frames_that_share_too_little_are_refused() -> None:
    with pytest.raises(DappledError, match="needs frames that overlap"):
        stereo_pair.pair(seen.flown([(0.0, 0.0), (60.0, 0.0)], gsd_m=0.1))
