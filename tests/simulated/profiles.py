"""Camera profiles of simulated frames: the reference camera's pixels on chips of other sizes."""

from __future__ import annotations


def raw_table(height: int, width: int) -> str:
    """The table of raw frames of this many rows and columns."""
    return (
        f'[[raw]]\nname = "{height} x {width}"\nshape = [{height}, {width}]\n'
        "row_mm = [0.01, 0.0]\ncolumn_mm = [0.0, 0.01]\n"
    )


def profile(height: int, width: int) -> str:
    """The reference camera with a chip of this many rows and columns."""
    return f'law = "geometric"\nmask_distance_mm = 0.48\n{raw_table(height, width)}'
