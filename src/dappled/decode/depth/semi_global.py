"""Semi-global matching (Hirschmüller 2008) of a cost volume: what neighbours say decides where a pixel can't.

Along each of four directions the best path's cost is L(p, d) = C(p, d) + min(L(q, d), L(q, d±1) + P1, min L(q) + P2)
− min L(q), q being the pixel before p; their sum over the directions is the smoothed volume.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dappled.decode.threads import each

Volume = NDArray[np.float32]


def smoothed(cost: Volume, *, small: float, large: float, workers: int = 1) -> Volume:
    """float32 (D, h, w), the mean over four directions; `small` and `large` are P1 and P2 in the cost's unit."""
    total = np.empty_like(cost)
    for axis in (0, 1):
        lines = np.ascontiguousarray(np.moveaxis(cost, axis + 1, 0))  # (n, D, m)
        paths = [np.empty_like(lines), np.empty_like(lines)]

        def one(way: int, lines: Volume = lines, paths: list[Volume] = paths) -> None:
            _along(lines[::-1] if way else lines, paths[way][::-1] if way else paths[way], small, large)

        each(one, (0, 1), workers)
        paths[0] += paths[1]
        if axis == 0:
            total[...] = np.moveaxis(paths[0], 0, 1)
        else:
            total += np.moveaxis(paths[0], 0, 2)
    total *= np.float32(0.25)
    return total


def _along(lines: Volume, out: Volume, small: float, large: float) -> None:
    """The paths' costs (n, D, m) from the first line to the last."""
    out[0] = lines[0]
    for i in range(1, len(lines)):
        previous, best = out[i - 1], out[i]
        least = previous.min(axis=0)
        np.minimum(previous, least + np.float32(large), out=best)
        if len(best) > 1:
            np.minimum(best[1:], previous[:-1] + np.float32(small), out=best[1:])
            np.minimum(best[:-1], previous[1:] + np.float32(small), out=best[:-1])
        best -= least
        best += lines[i]
