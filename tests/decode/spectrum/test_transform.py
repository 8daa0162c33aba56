from __future__ import annotations

import numpy as np
import pytest

from dappled.decode.errors import DecodeError
from dappled.decode.spectrum.developer import developer
from dappled.decode.spectrum.equations import padded_plane
from dappled.decode.spectrum.transform import Transform

MOSAIC = np.random.default_rng(7).integers(200, 3500, (197, 251), dtype=np.uint16)
BAYER = np.array([[0, 1], [1, 2]])


@pytest.mark.parametrize("largest_fx", [0.05, 0.2, 0.5])
def test_developing_while_transforming_is_developing_first(largest_fx: float) -> None:
    exposure = developer(MOSAIC.shape, black=100, white=4095, cfa=BAYER, reference=(1,)).expose(MOSAIC)
    plane = exposure.plane()
    transform = Transform(MOSAIC.shape)
    for source in (exposure, plane):
        spectrum = transform.apply(source, largest_fx=largest_fx)
        whole = np.fft.rfft2(padded_plane(plane, spectrum.level))[:, : spectrum.columns]
        off = np.abs(spectrum.half - whole)
        off[0, 0] = 0  # the mean: below
        assert off.max() < 1e-5 * np.abs(whole).max()
        assert spectrum.columns == min(whole.shape[1], int(np.ceil(largest_fx * spectrum.padded[1])) + 2)
        assert spectrum.mean == pytest.approx(float(plane.mean(dtype=np.float64)), rel=1e-5)


def test_a_used_buffer_leaves_nothing_behind() -> None:
    plane = np.random.default_rng(1).random((90, 130)).astype(np.float32)
    used = Transform((90, 130))
    used.apply(plane * 5)
    used.apply(plane, largest_fx=0.1)
    fresh = Transform((90, 130)).apply(plane, workers=3)
    assert used.apply(plane).half.tobytes() == fresh.half.tobytes()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_pixel_that_is_no_number_is_told(value: float) -> None:
    plane = np.random.default_rng(1).random((90, 130)).astype(np.float32)
    plane[71, 33] = value
    with pytest.raises(DecodeError, match="NaN or infinite"), np.errstate(invalid="ignore"):
        Transform((90, 130)).apply(plane)


def test_another_shape_is_refused() -> None:
    with pytest.raises(DecodeError, match="this transform is for"):
        Transform((90, 130)).apply(np.zeros((90, 131), dtype=np.float32))
