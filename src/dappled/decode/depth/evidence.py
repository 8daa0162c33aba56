"""Evidence for depth: the measurements of a light field that a frame contains, and their noise.

Everything measured is linear in the light field: B = K·L + noise of variance n, L being the views that a perfect
camera would see. Of plain views K is the identity. Of a masked frame B are its slices over their transfers: angular
Fourier coefficients. The views of a noisy masked frame must not be used in their place: they are drawn towards their
mean where the noise is strong, and their parallax shrinks.

For any shear of the light field the best picture and its likelihood follow from two things only: the back-projected
views Q = Kᵀ B/n and the weights W = Kᵀ K/n.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from dappled.decode.errors import DecodeError
from dappled.decode.lightfield import LightField, ViewStack
from dappled.decode.lightfield.aperture import Aperture
from dappled.decode.lightfield.light_field import Image, needs_parallax
from dappled.decode.lightfield.views import finest_detail

# Chosen by hand where no figure stands beside a number; benchmarks/depth.py measures what all of them together make.

_LEAST_NOISE = 1e-9  # variance: float32
_NOISE_FREE = 5e-3  # of the variance of a view's fine detail
_UNMEASURED = 1e-6  # of the weight of what was measured best
_DETAIL = 3.0  # px: sigma
# px of the outermost view, on masked frames of benchmarks/depth.py without noise, seeds 1 and 2: 69 % within σ, not 58
_SHARED = 0.03
CELLS = 2  # of a filled aperture along each axis of a view: three explain a frame hardly better
_MANY = 7  # views a side: 5 of 9 find the range of boards and fences (benchmarks/depth.py, seeds 1-3) to 0.02 px/view


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """`images` Q float32 (V, U, h, w) and `weights` W (V·U, V·U) of the views in `stack` (grey).

    `stack.views` are the views without any shrinking: unbiased, and noisier than the views made for display. `white`
    says that n is the frame's own white noise and each sample a measurement of its own; else it is a guess from the
    views. `made` are the views of a masked frame as they were made for display (grey), where the frame has next to no
    noise and they were plainly inverted; else None. `middle` is the middle view of a masked frame as it was made for
    display (grey): its edges are where they are in the scene. `shared`: by how much whole neighbourhoods are wrong,
    in pixels of the outermost view. `filled` (V·U, P): the views that light through each of P cells of a filled
    aperture adds to, where views are light through points; W·`filled` is then what the measurements have of it. None:
    light comes through points, or the views are of a round stop, whose cells `weights` has.
    """

    stack: ViewStack
    images: NDArray[np.float32]
    weights: NDArray[np.float64]
    white: bool
    made: ViewStack | None = None
    middle: Image | None = None
    shared: float = 0.0
    filled: NDArray[np.float64] | None = None

    def shown(self) -> Image:
        """The grey middle view to look for edges in."""
        return self.stack.middle() if self.middle is None else self.middle

    def lags(self) -> NDArray[np.float64]:
        """(2V−1, 2U−1) sums of W over pairs of views with the same separation."""
        v, u = self.stack.views.shape[:2]
        total = np.zeros((2 * v - 1, 2 * u - 1))
        rows, columns = np.divmod(np.arange(v * u), u)
        np.add.at(
            total, (rows[:, None] - rows[None, :] + v - 1, columns[:, None] - columns[None, :] + u - 1), self.weights
        )
        return total

    def picture(self) -> Image:
        """The grey picture as the aperture's middle sees it, with the noise of all views averaged out."""
        made: Image = self.stack.views.mean(axis=(0, 1), dtype=np.float32)
        return made


def of_views(stack: ViewStack, noise_rms: float | None = None) -> Evidence:
    """Evidence of plain views. `noise_rms` of a view's pixel; None: what the views' finest detail has.

    Raises DecodeError where all views are at one place, or hold values that are not numbers.
    """
    needs_parallax(stack, "depth")
    grey = stack.grey()
    if not np.isfinite(grey.views).all():
        raise DecodeError("the views hold values that are not numbers: decode the frame again")
    variance = _LEAST_NOISE + (noise_rms**2 if noise_rms is not None else view_noise(grey.views))
    count = grey.views.shape[0] * grey.views.shape[1]
    return Evidence(grey, grey.views / np.float32(variance), np.eye(count) / variance, white=noise_rms is not None)


def of_made(made: ViewStack) -> Evidence:
    """Evidence of views that a masked frame next to without noise was made into: what the inversion leaves of other
    views and pixels moves whole neighbourhoods."""
    return replace(of_views(made), shared=_SHARED)


def thinned(evidence: Evidence) -> Evidence:
    """The same of every second row and column of many plain views, the outermost ones among them."""
    stack = evidence.stack
    rows, columns = (2 if count >= _MANY and count % 2 else 1 for count in stack.views.shape[:2])
    images, views = evidence.images[::rows, ::columns], stack.views[::rows, ::columns]
    kept = np.arange(evidence.weights.shape[0]).reshape(stack.views.shape[:2])[::rows, ::columns].ravel()
    fewer = ViewStack(views, stack.row_steps[::rows], stack.column_steps[::columns], stack.sensor_px_per_disparity)
    return replace(evidence, stack=fewer, images=images, weights=evidence.weights[np.ix_(kept, kept)])


def of_light_field(field: LightField) -> Evidence:
    """Evidence of a masked frame's slices, where their transfers and noise are known; else of the views.

    Raises DecodeError where there are no views.
    """
    stack = ViewStack.of(field)
    rows, noise = field.attributes.get("transfers"), field.attributes.get("noise_rms")
    if rows is None or not noise:
        return of_views(stack)
    needs_parallax(stack, "depth")
    table = np.asarray(rows, dtype=np.float64)
    transfers = table[:, 2] + 1j * table[:, 3]
    used = transfers != 0
    if table.shape != (len(field.slices), 4) or not used.any():
        raise DecodeError("the light field's transfers don't fit its slices: decode the frame again")
    angular, transfers = table[used, :2], transfers[used]
    aperture = Aperture(field.views.shape[0], field.attributes.get("aperture") or "beams")
    kernel = aperture.cells(angular)
    # The band that a slice takes of the frame's spectrum holds that share of the frame's white noise.
    band = 1 / float(np.hypot(*field.grid[:, 0]) * np.hypot(*field.grid[:, 1]))
    variance = max(float(noise) ** 2 * band, _LEAST_NOISE)
    twice = np.where(np.all(angular == 0, axis=1), 1.0, 2.0)  # a carrier stands for its conjugate too
    back = (kernel.conj() * (twice * transfers.conj() / variance)[:, None]).T
    slices = field.slices if used.all() else field.slices[used]
    flat = slices.reshape(len(slices), -1)
    images = back.real.astype(np.float32) @ flat.real - back.imag.astype(np.float32) @ flat.imag
    weights = ((kernel.conj().T * (twice * np.abs(transfers) ** 2 / variance)) @ kernel).real
    shape = field.views.shape[:4]
    plain = _plain_views(images, weights).reshape(shape)
    return Evidence(
        ViewStack(plain, stack.row_steps, stack.column_steps, stack.sensor_px_per_disparity),
        np.ascontiguousarray(images.reshape(shape), dtype=np.float32),
        weights,
        white=True,
        made=_noise_free(stack.grey(), weights, field),
        middle=stack.grey().middle(),
        filled=None
        if aperture.shape == "round"
        else _filled(kernel, Aperture(CELLS * aperture.views, "filled"), angular),
    )


def _filled(kernel: NDArray[np.complex128], aperture: Aperture, angular: NDArray[np.float64]) -> NDArray[np.float64]:
    """(J, P): what has to be added to J views of a kernel (K, J) for the light of each cell of a filled aperture, so
    that it shows in the slices as it does there."""
    views, cells = (np.concatenate([k.real, k.imag]) for k in (kernel, aperture.cells(angular)))
    made: NDArray[np.float64] = np.linalg.pinv(views, rcond=_UNMEASURED) @ cells
    return made


def _noise_free(made: ViewStack, weights: NDArray[np.float64], field: LightField) -> ViewStack | None:
    """The views, where their noise is far below their texture; None for others, and for those of the joint model,
    which are drawn to one disparity a patch."""
    if field.attributes.get("views_model") == "joint":
        return None
    values = np.linalg.eigvalsh(weights)
    noise = float(np.median(1 / values[values > _UNMEASURED * values[-1]]))
    middle = made.middle()
    texture = float(np.var(middle - ndimage.gaussian_filter(middle, _DETAIL)))
    return made if noise < _NOISE_FREE * texture else None


def view_noise(views: NDArray[np.float32]) -> float:
    """Variance of a view's noise: the least that any view's finest detail allows for (it holds texture too)."""
    flat = views.reshape(-1, *views.shape[2:4])
    return min(finest_detail(view.astype(np.complex64)) for view in flat[:: max(1, len(flat) // 9)])


def _plain_views(images: NDArray[np.float32], weights: NDArray[np.float64]) -> NDArray[np.float32]:
    """(J, pixels) the least-squares views W⁻¹Q; components without a measurement stay at the mean of the views."""
    values, vectors = np.linalg.eigh(weights)
    kept = values > 1e-9 * values[-1]
    inverse = (vectors[:, kept] / values[kept]) @ vectors[:, kept].T
    made: NDArray[np.float32] = inverse.astype(np.float32) @ images
    return made
