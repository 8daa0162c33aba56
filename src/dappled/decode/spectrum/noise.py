"""A plane's white noise, from the quietest parts of its spectrum."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from dappled.decode.spectrum.padded import Spectrum, hann
from dappled.decode.threads import each, spans

_SIDE = 34  # bins of a part that is looked at, one of its edge for the window
_PARTS = (8, 8)  # rows and columns of parts
_AT_ONCE = 8


class Noise:
    """The noise of one spectrum, in pieces of work that may be done beside other work, in any order."""

    def __init__(self, spectrum: Spectrum) -> None:
        sides = spectrum.padded[0], spectrum.columns
        counts = [max(1, min(most, side // 4)) for most, side in zip(_PARTS, sides, strict=True)]
        edges = [np.array_split(np.arange(side), count) for side, count in zip(sides, counts, strict=True)]
        self._spectrum = spectrum
        self._high, self._wide = (min(_SIDE, *(part.size for part in parts)) for parts in edges)
        self._corners = [(int(rows[0]), int(columns[0])) for rows in edges[0] for columns in edges[1]]
        self._medians = np.empty(len(self._corners))
        self.work: list[Callable[[], None]] = [
            partial(self._look, part) for part in spans(len(self._corners), _AT_ONCE)
        ]

    def _look(self, some: slice) -> None:
        """The median power of some parts, under a Hann window: edges of the frame don't leak."""
        parts = [self._spectrum.block(*corner, self._high, self._wide) for corner in self._corners[some]]
        quiet = hann(np.array(parts))
        power = (quiet.real**2 + quiet.imag**2).reshape(len(parts), -1)
        middle = power.shape[1] // 2
        self._medians[some] = np.partition(power, middle, axis=1)[:, middle]

    def rms(self) -> float:
        """One standard deviation a pixel, once all the work is done.

        The tenth percentile of the parts' medians: bands, carriers and colour replicas only cover some. An upper bound
        where every part holds signal.
        """
        power = float(np.quantile(self._medians, 0.1)) / math.log(2)  # the median of an exponential is ln 2 of its mean
        power *= (8 / 3) ** 2  # the window's mean square is 3/8 an axis
        return math.sqrt(power / (self._spectrum.shape[0] * self._spectrum.shape[1]))


def noise_rms(spectrum: Spectrum, *, workers: int = 1) -> float:
    """The plane's white noise, one standard deviation a pixel."""
    noise = Noise(spectrum)
    each(lambda work: work(), noise.work, workers)
    return noise.rms()
