"""Make the views of a masked frame from its slices, by the model that suits the frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dappled.decode.lightfield.aperture import Aperture, angular_frequencies
from dappled.decode.lightfield.joint_views import SIDE, joint_views
from dappled.decode.lightfield.slice_model import SliceModel
from dappled.decode.lightfield.views import Views, chroma_noise, from_slices
from dappled.decode.optics import Carrier

ViewsModel = Literal["joint", "independent"]
_REACH = 1.0  # samples of a slice from view to view: a carrier's order further, and parallax can't be told apart
_WIDER = 2.0  # times that, where a frame's disparities are at the ends of the range
_AT_THE_ENDS = 0.1  # of a frame
_MOST_VIEWS = 5  # along an axis: with more, the outer ones move by more than a patch can tell, and nobody measured it
_CLEAN = 5e-4  # of the mean: with less noise, and so without folded detail, inverting is better than modelling


@dataclass(frozen=True, slots=True, eq=False)
class FrameViews:
    """`views` float32 (V, U, h, w), by which model they were made, and the standard errors of views, rows of V × U, in
    the plane's unit; None where the model tells none."""

    views: Views
    model: ViewsModel
    sigma: list[list[float]] | None


def views_of(
    slices: NDArray[np.complex64],
    carriers: Sequence[Carrier],
    transfers: NDArray[np.complex128],
    *,
    kappa_cycles: float,
    rotation_rad: float,
    aperture: Aperture,
    samples_px: tuple[float, float],
    row_over_column: float,
    noise_variance: float,
    colours: bool,
    joint: bool,
) -> FrameViews:
    """The views of slices complex64 (K, h, w), DC first, cut at `carriers`; see `views.from_slices`.

    `samples_px` are the rows and columns of the sensor in a sample of a slice, `row_over_column` the height of a pixel
    over its width. With `joint` views are made by the joint model, unless slices are smaller than a patch, there are
    more views than it was measured with or fewer orders than views have, the frame has next to no noise, or disparities
    are beyond the widest range.
    """
    orders = [(c.ky, c.kx) for c in carriers]
    plane_variance = noise_variance * samples_px[0] * samples_px[1]
    clean = plane_variance < (_CLEAN * float(slices[0].real.mean())) ** 2

    def independent() -> FrameViews:
        made, _ = from_slices(
            slices,
            orders,
            transfers,
            kappa_cycles=kappa_cycles,
            rotation_rad=rotation_rad,
            aperture=aperture,
            noise_variance=noise_variance,
            colours=colours,
        )
        return FrameViews(made, "independent", None)

    few = len(orders) < (aperture.views**2 + 1) // 2
    if not joint or clean or few or min(slices.shape[1:]) < SIDE or aperture.views > _MOST_VIEWS:
        return independent()
    angular = angular_frequencies(orders, kappa_cycles, rotation_rad)
    variances = np.full(len(slices), noise_variance)
    if colours:
        variances += chroma_noise(slices, transfers * aperture.transform(angular))
    frequencies = np.array([(c.fy / row_over_column, c.fx) for c in carriers])
    model = SliceModel.of_half(orders, transfers, angular, frequencies, aperture)
    samples = samples_px[0] * row_over_column, samples_px[1]
    reach = _REACH * aperture.views * samples_px[1]
    found = joint_views(slices, model, samples_px=samples, noise=variances, reach=reach)
    if found.at_the_ends > _AT_THE_ENDS:
        wider = joint_views(slices, model, samples_px=samples, noise=variances, reach=_WIDER * reach)
        found = max(found, wider, key=lambda one: one.log_likelihood)
        if found.at_the_ends > _AT_THE_ENDS:
            return independent()  # it supposes no range
    return FrameViews(found.views, "joint", found.sigma.tolist())
