"""Estimate depth from refocus contrast: at the right disparity, the views add up to the sharpest picture.

Shearing is a phase in the spectrum, so one inverse FFT a disparity is enough. With Q and W of `evidence`, and
φ_j = exp(2πi D f·step_j), the most probable picture at disparity D is Z/G, Z = Σ_j φ_j Q_j, G = Σ_jk φ_j* W_jk φ_k.
What it explains of the measurements is |Z|²/G, counted in variances of the noise. For plain views that is the energy of
Eq 29's picture; for noisy slices each order has the weight of its information.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.depth.depth_map import DepthMap, Search, Volume, box, confidence, judged, peaked, windowed
from dappled.decode.depth.evidence import Evidence
from dappled.decode.lightfield.light_field import centred
from dappled.workers import each, spans

# Chosen by hand where no figure stands beside a number; benchmarks/depth.py measures what all of them together make.

_COARSEST = 0.04  # cycles/pixel: coarser detail carries no depth, and outweighs the detail that does
_PAD = 16  # px
_CHUNK = 6  # disparities whose spectra are in memory at once
_LEAST_WEIGHT = 1e-3  # of the whole: frequencies at which nothing was measured


def depth(evidence: Evidence, search: Search) -> DepthMap:
    """The depth map of the disparity whose picture explains most in a window around each pixel."""
    disparities = search.disparities()
    likelihood, spread = windowed(explained(evidence, disparities, workers=search.workers), search.contrast_window)
    disparity, curvature = peaked(likelihood, disparities, likelihood.argmax(axis=0))
    sure = confidence(likelihood, likelihood.max(axis=0), float(box(search.contrast_window) ** 2))
    return judged(disparity, curvature, sure, spread=spread, window=search.contrast_window, method="contrast")


def explained(evidence: Evidence, disparities: NDArray[np.float64], *, workers: int = 1) -> Volume:
    """float32 (D, h, w): half of what each disparity's picture explains at a pixel, in squared noise sigmas.

    Its sum over a window is the log-likelihood of the disparity there, but for a constant.
    """
    images, stack = evidence.images, evidence.stack
    count_v, count_u, height, width = images.shape
    shape = fft.next_fast_len(height + 2 * _PAD), fft.next_fast_len(width + 2 * _PAD, real=True)
    margins = ((0, 0), (0, 0), (_PAD, shape[0] - height - _PAD), (_PAD, shape[1] - width - _PAD))
    spectra = fft.rfft2(np.pad(images, margins, mode="symmetric"), workers=workers, overwrite_x=True)
    fy, fx = fft.fftfreq(shape[0]), fft.rfftfreq(shape[1])
    # For products (fy, u) @ (u, D), one a column and row of views: too small for BLAS to start threads of its own.
    columns = np.ascontiguousarray(spectra.transpose(3, 0, 2, 1))
    lags = evidence.lags()
    spacing = [abs(s[1] - s[0]) if len(s) > 1 else 0.0 for s in (stack.row_steps, stack.column_steps)]
    signs = [np.sign(s[-1] - s[0]) for s in (stack.row_steps, stack.column_steps)]
    radius2 = fy[:, None] ** 2 + fx[None, :] ** 2
    pass_band = 1 - np.exp(-radius2 / (2 * _COARSEST**2))
    out = np.empty((len(disparities), height, width), dtype=np.float32)

    def one(part: slice) -> None:
        chosen = disparities[part]
        turn_x = np.exp(2j * np.pi * fx[:, None, None] * stack.column_steps[None, :, None] * chosen)
        summed = columns @ turn_x.astype(np.complex64)[:, None]
        turn_y = np.exp(2j * np.pi * stack.row_steps[:, None, None] * fy[:, None] * chosen).astype(np.complex64)
        total = summed[:, 0] * turn_y[0]
        for v in range(1, count_v):
            summed[:, v] *= turn_y[v]
            total += summed[:, v]
        for k, disparity in enumerate(chosen):
            lag_y = np.exp(2j * np.pi * disparity * signs[0] * spacing[0] * np.outer(fy, centred(2 * count_v - 1)))
            lag_x = np.exp(2j * np.pi * disparity * signs[1] * spacing[1] * np.outer(fx, centred(2 * count_u - 1)))
            weight = (lag_y @ lags @ lag_x.T).real
            gain = pass_band / np.sqrt(np.maximum(weight, _LEAST_WEIGHT * lags.sum()))
            picture = fft.irfft2(total[:, :, k].T * gain.astype(np.float32), s=shape)
            inner = picture[_PAD : _PAD + height, _PAD : _PAD + width]
            np.multiply(inner, inner, out=out[part.start + k])
            out[part.start + k] *= 0.5

    each(one, spans(len(disparities), _CHUNK), workers)
    return out
