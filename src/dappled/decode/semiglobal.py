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
    ways = [(axis, backwards) for axis in (0, 1) for backwards in (False, True)]
    sums = [np.empty(0, dtype=np.float32)] * len(ways)

    def one(number: int) -> None:
        axis, backwards = ways[number]
        lines = np.ascontiguousarray(np.moveaxis(cost, axis + 1, 0))  # (n, D, m)
        order = range(len(lines) - 1, -1, -1) if backwards else range(len(lines))
        previous: NDArray[np.float32] | None = None
        scratch = np.empty_like(lines[0])
        for i in order:
            if previous is not None:
                least = previous.min(axis=0)
                best = np.minimum(previous, least + np.float32(large), out=scratch)
                if len(best) > 1:
                    np.minimum(best[1:], previous[:-1] + np.float32(small), out=best[1:])
                    np.minimum(best[:-1], previous[1:] + np.float32(small), out=best[:-1])
                best -= least
                lines[i] += best
            previous = lines[i]
        sums[number] = np.moveaxis(lines, 0, axis + 1)

    each(one, range(len(ways)), workers)
    total = sums[0].astype(np.float32, order="C")
    for part in sums[1:]:
        total += part
    total /= np.float32(len(ways))
    return total
