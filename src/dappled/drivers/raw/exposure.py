"""How a raw frame is exposed: a histogram of its linear values, the share of clipped pixels, the mean."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dappled.drivers.raw.reading import RawFile

WHITE_SHARE = 0.99  # of white: a pixel of so much light is clipped
STEPS = 64
_EVERY = 5  # odd, so that the colours of a mosaic take turns


@dataclass(frozen=True, slots=True)
class Exposure:
    """`histogram`: shares of the pixels in STEPS equal steps of the square root of the linear value, black to white.
    `clipped_share` of them are white; `mean_share` is the mean as a share of white."""

    histogram: tuple[float, ...]
    clipped_share: float
    mean_share: float


def exposure(raw: RawFile, every: int = _EVERY) -> Exposure:
    """Measure one pixel of `every` × `every`."""
    black = float(np.mean(raw.black))
    values = raw.mosaic[::every, ::every].astype(np.float32)
    share = (values - black) / (raw.white - black)
    counts, _ = np.histogram(np.sqrt(np.clip(share, 0, 1)), STEPS, (0, 1))
    shares = tuple(float(one) for one in counts / share.size)
    return Exposure(shares, float(np.mean(share >= WHITE_SHARE)), float(np.mean(share)))
