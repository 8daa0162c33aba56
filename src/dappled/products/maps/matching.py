"""Find the same ground in two pictures: SIFT features, mutual nearest neighbours, and a homography by MAGSAC."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats
from dappled.products.extras import need

_LIMIT = 4000  # features per picture
_PATCHES = 600  # per picture, about
_PATCH, _NUDGED = 25, 4  # pixels: the side of a patch, and how far it is looked for
_REACH = 6  # pictures ahead that are tried as neighbours
_RATIO = 0.85  # at most, of the best match's distance to the second best's


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """`pixels` float64 (n, 2) as (x, y), and their SIFT descriptors (n, 128)."""

    pixels: Floats
    descriptors: NDArray[np.float32]


def features(image: NDArray[np.floating]) -> Features:
    """The features of a picture (h, w) or (h, w, c) of any brightness scale, only well inside of what is known."""
    cv2 = need("cv2")
    grey = np.asarray(image, dtype=np.float32)
    grey = grey.mean(axis=2) if grey.ndim == 3 else grey
    seen = np.isfinite(grey)
    if not seen.any():
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    low, high = np.percentile(grey[seen], (0.5, 99.5))
    levels = np.clip((np.where(seen, grey, low) - low) / max(high - low, 1e-12), 0, 1)
    eight = np.round(255 * np.sqrt(levels)).astype(np.uint8)
    mask = None if seen.all() else cv2.erode(seen.astype(np.uint8) * 255, np.ones((9, 9), np.uint8))
    points, descriptors = cv2.SIFT_create(nfeatures=_LIMIT, contrastThreshold=0.02).detectAndCompute(eight, mask)
    if descriptors is None:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    return Features(np.array([point.pt for point in points], dtype=np.float64), descriptors)


def of_all(images: Sequence[NDArray[np.floating]], progress: Callable[[str, int, int], None]) -> list[Features]:
    """The features of each picture."""
    found = []
    for number, image in enumerate(images):
        progress("find features", number, len(images))
        found.append(features(image))
    return found


def neighbours(count: int, progress: Callable[[str, int, int], None]) -> Iterator[tuple[int, int]]:
    """The pairs of so many pictures in a row that are near enough to each other to be tried."""
    for number in range(count):
        progress("match neighbours", number, count)
        yield from ((number, other) for other in range(number + 1, min(number + 1 + _REACH, count)))


def matched(a: Features, b: Features) -> NDArray[np.intp]:
    """(n, 2) indices of features that are each other's nearest by a clear margin."""
    if min(len(a.pixels), len(b.pixels)) < 2:
        return np.zeros((0, 2), dtype=np.intp)
    matcher = need("cv2").BFMatcher()
    forth = matcher.knnMatch(a.descriptors, b.descriptors, k=2)
    back = matcher.knnMatch(b.descriptors, a.descriptors, k=1)
    clear = [
        m for m, second in forth if m.distance < _RATIO * second.distance and back[m.trainIdx][0].trainIdx == m.queryIdx
    ]
    return np.array([(m.queryIdx, m.trainIdx) for m in clear], dtype=np.intp).reshape(-1, 2)


def on_one_plane(a: Floats, b: Floats, threshold_px: float) -> NDArray[np.bool_]:
    """(n,): which pairs (n, 2) fit one homography within the threshold; all False where there are too few."""
    none = np.zeros(len(a), dtype=bool)
    if len(a) < 8:
        return none
    cv2 = need("cv2")
    found, inside = cv2.findHomography(
        a.astype(np.float32), b.astype(np.float32), cv2.USAC_MAGSAC, threshold_px, None, 10_000, 0.9999
    )
    return none if found is None else np.asarray(inside.ravel() > 0)


def nudges(image: NDArray[np.floating], like: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """(places (n, 2), shifts (n, 2)) in px: where patches of `image` are found in `like`, a picture of the same shape
    that shows nearly the same, to a fraction of a pixel. Patches with a correlation below 0.7 or near NaN are left out.
    """
    cv2 = need("cv2")
    a, b = (np.asarray(one, np.float32).mean(axis=2) if one.ndim == 3 else np.asarray(one, np.float32)
            for one in (image, like))  # fmt: skip
    rows, columns = a.shape
    half, reach, step = _PATCH // 2, _NUDGED, max(_PATCH // 2, round(math.sqrt(rows * columns / _PATCHES)))
    places, shifts = [], []
    for row in range(half + reach, rows - half - reach, step):
        for column in range(half + reach, columns - half - reach, step):
            small = a[row - half : row + half + 1, column - half : column + half + 1]
            large = b[row - half - reach : row + half + reach + 1, column - half - reach : column + half + reach + 1]
            if not (np.isfinite(small).all() and np.isfinite(large).all()) or float(small.std()) == 0:
                continue
            score = cv2.matchTemplate(np.ascontiguousarray(large), np.ascontiguousarray(small), cv2.TM_CCOEFF_NORMED)
            y, x = (int(k) for k in np.unravel_index(int(np.argmax(score)), score.shape))
            if not (0 < y < 2 * reach and 0 < x < 2 * reach and score[y, x] > 0.7):
                continue
            places.append((column, row))
            shifts.append((x - reach + _top(score[y, x - 1 : x + 2]), y - reach + _top(score[y - 1 : y + 2, x])))
    return np.array(places, float).reshape(-1, 2), np.array(shifts, float).reshape(-1, 2)


def _top(three: NDArray[np.floating]) -> float:
    """The position of the top of a parabola through three values, of which the middle one is the greatest."""
    before, here, after = (float(v) for v in three)
    bend = before - 2 * here + after
    return 0.5 * (before - after) / bend if bend < 0 else 0.0
