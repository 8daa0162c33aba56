"""How strong a mask's shadow is, by texture alone: on slices made by the physics, at the aperture that leaves no
carriers."""

from __future__ import annotations

import pytest

from tests.decode.joint.test_mask_place import _moved, _place, _slices


@pytest.mark.parametrize("disparities", [(-4.0, 6.0), (-15.0, 10.0)])
@pytest.mark.parametrize("contrast", [1.0, 0.6])
def test_texture_tells_a_faded_shadow(contrast: float, disparities: tuple[float, float]) -> None:
    slices = _moved(_slices(2, disparities=disparities), (0.01, -0.005), 0.0002)
    slices[1:] *= contrast
    found = _place(slices)
    assert found.seen
    assert found.contrast is not None
    assert found.contrast_sigma is not None
    assert found.contrast == pytest.approx(contrast, abs=0.06)
    assert 0.005 < found.contrast_sigma < 0.04
