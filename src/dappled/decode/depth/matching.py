"""Semi-global matching: costs of disparities together with those of the neighbours along four directions."""

from __future__ import annotations

import numpy as np

from dappled.decode.depth.depth_map import Volume
from dappled.workers import each, spans

_LINES = 256  # beside each other at a time: a copy of so many is in memory


def smoothed(cost: Volume, *, small: float, large: float, workers: int = 1) -> Volume:
    """Semi-global matching (Hirschmüller 2008): float32 (D, h, w), the mean over four directions.

    Along each direction the best path's cost is L(p, d) = C(p, d) + min(L(q, d), L(q, d±1) + P1, min L(q) + P2)
    − min L(q), q being the pixel before p. `small` and `large` are P1 and P2 in the cost's unit.
    """
    total = np.empty_like(cost)

    def down(columns: slice) -> None:
        _both_ways(cost[:, :, columns].transpose(1, 0, 2), total[:, :, columns].transpose(1, 0, 2), small, large)

    def across(rows: slice) -> None:
        lines = np.ascontiguousarray(cost[:, rows].transpose(2, 0, 1))
        sums = np.empty_like(lines)
        _both_ways(lines, sums, small, large)
        part = total[:, rows]
        part += sums.transpose(1, 2, 0)
        part *= np.float32(0.25)

    each(down, spans(cost.shape[2], _LINES), workers)
    each(across, spans(cost.shape[1], _LINES), workers)
    return total


def _both_ways(lines: Volume, total: Volume, small: float, large: float) -> None:
    """The paths' costs from the first line (n, D, m) to the last, and those of the way back, added up in `total`."""
    jump = np.full(lines.shape[2], large, np.float32)  # NumPy is slower with a scalar
    for back in (False, True):
        path, dearer = np.zeros(lines.shape[1:], np.float32), np.empty(lines.shape[1:], np.float32)
        best = np.empty_like(path)
        for i in range(len(lines) - 1, -1, -1) if back else range(len(lines)):
            path -= path.min(axis=0)
            np.minimum(path, jump, out=best)
            np.add(path, np.float32(small), out=dearer)
            np.minimum(best[1:], dearer[:-1], out=best[1:])
            np.minimum(best[:-1], dearer[1:], out=best[:-1])
            best += lines[i]
            if back:
                total[i] += best
            else:
                total[i] = best
            path, best = best, path
