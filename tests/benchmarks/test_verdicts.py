"""Verdicts against simulated motion, defocus and clipping of known severity, by the issue's own measure."""

from __future__ import annotations

import pytest

from tests.benchmarks import program


@pytest.mark.long
@pytest.mark.parametrize("cause", ["motion", "defocus", "clipping"])
def test_truly_bad_frames_are_called_bad_and_fine_ones_are_not(cause: str) -> None:
    """Without the margin that keeps the border's ringing out, 88 to 99 % of the defocused frames were found."""
    verdicts = program("verdicts")
    pairs, bound, truly = verdicts.causes(600, 2)[cause]
    made = verdicts.figures(list(pairs), bound, truly)
    assert made["bad_frames"] + made["fine_frames"] >= 400
    assert made["found"] >= 0.95
    assert made["false"] <= 0.02
