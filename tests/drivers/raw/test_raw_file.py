"""The exposure of a raw frame: histogram, clipped share, mean."""

from __future__ import annotations

import numpy as np
import pytest

from dappled.drivers.raw.raw_file import STEPS, ExposureSettings, RawFile, exposure

WHITE, BLACK = 4095, 128


def raw(share: float, clipped_rows: int = 0, every_other: float | None = None) -> RawFile:
    """A frame of one linear value, with some rows at white; every other column has another value."""
    values = np.full((300, 400), BLACK + share * (WHITE - BLACK))
    if every_other is not None:
        values[:, 1::2] = BLACK + every_other * (WHITE - BLACK)
    values[:clipped_rows] = WHITE
    more = {"cfa": None, "colour_names": (), "balance": None}
    return RawFile.of(ExposureSettings(), np.round(values).astype(np.uint16), black=BLACK, white=WHITE, **more)


def test_a_value_stands_in_its_step() -> None:
    found = exposure(raw(0.25))
    assert sum(found.histogram) == pytest.approx(1)
    assert int(np.argmax(found.histogram)) in (STEPS // 2 - 1, STEPS // 2)  # √0.25 is the middle
    assert found.mean_share == pytest.approx(0.25, abs=1e-3)
    assert found.clipped_share == 0  # measured, and none: not the same as unknown


@pytest.mark.parametrize("rows", [30, 150, 300])
def test_the_clipped_share_is_counted(rows: int) -> None:
    found = exposure(raw(0.25, rows))
    assert found.clipped_share == pytest.approx(rows / 300, abs=0.02)
    assert found.histogram[-1] == pytest.approx(rows / 300, abs=0.02)


def test_one_colour_of_a_mosaic_that_is_clipped_is_seen() -> None:
    assert exposure(raw(0.2, every_other=1.0)).clipped_share == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("rows", [0, 150])
def test_the_black_share_is_counted(rows: int) -> None:
    dark = raw(0.25)
    dark.mosaic[:rows] = BLACK
    assert exposure(dark).black_share == pytest.approx(rows / 300, abs=0.02)
