"""How much light a lens loses towards the corners, estimated from the frame itself.

Vignetting takes a share that grows with the square of the distance from the middle. Brightness of scenes changes mostly
at edges, which are few; so slopes of the logarithm of brightness, fitted without regard for the large ones, tell a slow
loss better than brightness itself (after Zheng et al., "Single-image vignetting correction using radial gradient
symmetry"). A scene that is brightest in its middle looks the same: strips of the frame must agree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats
from dappled.findings import FRAME, Code, Finding, finding

_ROWS = 64  # of the reduced picture
_LEAST = 24  # samples of the shorter side
_BORDER = 2  # samples: a slice rings at the frame's edges
_DARK = 0.02  # of the mean
_STRIPS = 4  # in each direction
_TURNS = 10  # of the fit
_LARGE_SLOPE = 0.7  # robust standard deviations: from here on a slope counts less
_OWN = 0.05  # of the logarithm: the least standard error; a scene's light is never even to less
_STRIPS_ARE_ALIKE = 1.35  # times their scatter: 68 % of errors before boards are within, as strips share edges
# What is a doubt: see the figures in docs/decoding.md.
_LEAST_LOST, _MOST_LOST = 0.22, 0.65
_LEAST_SIGMAS = 3.75  # of the logarithm
_MOST_AGAINST = 1  # strips


@dataclass(frozen=True, slots=True)
class Falloff:
    """`lost` is the share of light that corners lose against the middle, below 0 where they are brighter, `sigma` its
    standard error, `against` how many of the frame's 8 strips are brighter at their ends than in their middle."""

    lost: float
    sigma: float
    against: int

    def finding(self) -> Finding | None:
        """That the loss is large, not larger than a lens', and clear of the scatter; else None."""
        if not _LEAST_LOST < self.lost < _MOST_LOST or self.against > _MOST_AGAINST:
            return None
        left = 1 - self.lost
        if -math.log(left) < _LEAST_SIGMAS * self.sigma / left:
            return None
        return finding(Code.FRAME_VIGNETTED, FRAME, lost=self.lost, sigma=self.sigma)


def falloff(picture: NDArray[np.floating]) -> Falloff | None:
    """The loss that a picture (h, w) shows, linear in the light; None where it is black, has fewer than 28 samples on a
    side, or values that are not numbers.

    The standard error comes from the scatter between strips: 4 side by side and 4 one below the other, whose ends are
    compared with their middles each by itself.
    """
    inner = np.asarray(picture[_BORDER:-_BORDER, _BORDER:-_BORDER], dtype=np.float64)
    if min(inner.shape) < _LEAST or not math.inf > (level := float(inner.mean())) > 0:
        return None
    step = max(1, round(min(inner.shape) / _ROWS))
    rows, columns = (side // step for side in inner.shape)
    blocks = inner[: rows * step, : columns * step].reshape(rows, step, columns, step).mean(axis=(1, 3))
    bright = np.log(np.maximum(blocks, _DARK * level))
    corner = math.hypot(picture.shape[0], picture.shape[1]) / (2 * step)  # in blocks: distances are 1 there
    y, x = ((np.arange(side) - (side - 1) / 2) / corner for side in (rows, columns))
    down, across = np.diff(bright, axis=0) * corner, np.diff(bright, axis=1) * corner
    between_y, between_x = (y[1:] + y[:-1]) / 2, (x[1:] + x[:-1]) / 2
    each = np.array(
        [
            *(_bend(strip, between_y[:, None]) for strip in np.array_split(down, _STRIPS, axis=1)),
            *(_bend(strip, between_x[None, :]) for strip in np.array_split(across, _STRIPS, axis=0)),
        ]
    )
    whole = _common_bend(down, across, between_y, between_x)
    sigma = math.hypot(_STRIPS_ARE_ALIKE * float(each.std(ddof=1)) / math.sqrt(len(each)), _OWN)
    left = math.exp(min(whole, 1.0))
    return Falloff(1 - left, left * sigma, int(np.sum(each > 0)))


def _bend(slopes: Floats, places: Floats) -> float:
    """c of slopes = constant + 2·c·place."""
    at = np.broadcast_to(places, slopes.shape).ravel()
    return float(_fitted(np.stack([np.ones_like(at), 2 * at], axis=1), slopes.ravel())[1])


def _common_bend(down: Floats, across: Floats, y: Floats, x: Floats) -> float:
    """c of log brightness = plane + c·(y² + x²), from its slopes along both axes."""
    at_y, at_x = (np.broadcast_to(at, g.shape).ravel() for at, g in ((y[:, None], down), (x[None, :], across)))
    model = np.zeros((down.size + across.size, 3))
    model[: down.size, 0], model[: down.size, 2] = 1, 2 * at_y
    model[down.size :, 1], model[down.size :, 2] = 1, 2 * at_x
    return float(_fitted(model, np.concatenate([down.ravel(), across.ravel()]))[2])


def _fitted(model: Floats, values: Floats) -> Floats:
    """Coefficients of a fit in which what is far off counts little, as under a Cauchy distribution."""
    weights: Floats = np.ones(len(values))
    found: Floats = np.zeros(model.shape[1])
    for _ in range(_TURNS):
        weighted = model.T * weights
        found = np.asarray(np.linalg.solve(weighted @ model, weighted @ values), dtype=np.float64)
        off = np.abs(values - model @ found)
        scale = max(1.4826 * float(np.median(off)), 1e-9)
        weights = 1 / (1 + (off / (_LARGE_SLOPE * scale)) ** 2)
    return found
