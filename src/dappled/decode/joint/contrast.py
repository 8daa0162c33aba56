"""Tell how strong a mask's shadow is against its calibration, by the texture of a frame's patches.

The means of slices tell it only where the stop leaves something of the carriers, and there another stop looks much the
same. Texture tells it wherever it has parallax: at a disparity D the spectra of a patch are T_k W(ω_k − D·f) ŝ(f), so
that a shadow of less contrast leaves less in all slices but the first, and in proportion, while another disparity
leaves it at other frequencies. Means are left out, and texture is made about white before patches are cut: long waves
that leak into short ones have less parallax than these, as if the shadow were faint.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.array_types import Complexes, Floats
from dappled.decode.joint.any_disparity import flat_nats
from dappled.decode.joint.patch_model import FrameModel, PatchKind, TexturePower, rests_of, whitener_of
from dappled.decode.joint.patches import Patches
from dappled.decode.lightfield.aperture import FAINTEST, STRONGEST

# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

_TRIED = 3  # of so many frequencies one is looked at
_DISPARITIES = 129  # over the usual range: few make up for what it misses by another contrast
_STEP = 0.15  # of the contrast's logarithm


def even_spectra(slices: Complexes, patches: Patches, which: NDArray[np.intp]) -> Complexes:
    """(F, A, N) spectra of `which` (N,) patches of slices (K, h, w), whose long waves don't leak into short ones: those
    that a filter makes about as strong, taken back."""
    down, across = (fft.fftfreq(side) for side in slices.shape[1:])
    radius = np.hypot(down[:, None], across[None]).astype(np.float32)
    uneven = fft.ifft2(fft.fft2(slices) * radius)
    at = np.hypot(*patches.bins.T)
    at[0] = 1
    return np.asarray(patches.spectra(patches.cut(uneven, which)) / at[:, None, None].astype(np.float32))


def shadow_contrast(
    frame: FrameModel,
    spectrum: TexturePower,
    kind: PatchKind,
    spectra: Complexes,
    *,
    mean: float,
    reach: float,
) -> tuple[float, float] | None:
    """The contrast over the model's, and its standard error if patches did not overlap.

    By the `even_spectra` (F, A, N) of patches of this `kind` in the usual range, of a mask in its place; None where no
    contrast between `FAINTEST` and `STRONGEST` is the most probable. `mean` as for `rests_of`, `reach` as for
    `FrameModel.of`.
    """
    few = slice(None, None, _TRIED)
    own = spectrum.at(frame.radius(frame.frequencies))
    seen = frame.model.seen(frame.frequencies[few], np.linspace(-reach, reach, _DISPARITIES)).transpose(1, 0, 2)
    seen = seen * np.sqrt(own[few]).astype(np.float32)[:, None, None]
    # As a shadow of the model's contrast leaves it: what is not as strong as foreseen is no contrast.
    whitener = whitener_of(rests_of(frame, spectrum, own, mean, [kind]).of(0, few))
    white = whitener.astype(np.complex64) @ spectra[few]
    weights = frame.weights[few] * (frame.weights.sum() / frame.weights[few].sum())

    def nats(steps: int) -> Floats:
        size = np.full(len(frame.noise), math.exp(_STEP * steps), dtype=np.float32)
        size[0] = 1
        return flat_nats(seen * size, whitener, white, weights)

    found = {steps: nats(steps) for steps in (-1, 0, 1)}
    while True:
        best = max(found, key=lambda steps: float(found[steps].sum()))
        if not FAINTEST <= math.exp(_STEP * best) <= STRONGEST:
            return None
        if missing := [steps for steps in (best - 1, best + 1) if steps not in found]:
            found |= {steps: nats(steps) for steps in missing}
            continue
        below, centre, above = (found[best + side] for side in (-1, 0, 1))
        slopes, curvatures = (above - below) / 2, 2 * centre - below - above
        curvature = float(curvatures.sum())
        if not curvature > 0:
            return None
        off = float(slopes.sum()) / curvature
        slopes = slopes - off * curvatures
        contrast = math.exp(_STEP * (best + off))
        sigma = math.sqrt(float(slopes @ slopes)) / curvature
        return contrast, contrast * _STEP * sigma
