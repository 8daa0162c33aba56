"""Make the views of a masked frame from its slices, by the model that suits the frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Floats, Singles
from dappled.decode.joint.joint_views import PatchShares, joint_views
from dappled.decode.joint.mask_place import MaskWitness, PlaceSearch
from dappled.decode.joint.patch_model import FARTHEST, SIDE
from dappled.decode.joint.slice_model import SliceModel
from dappled.decode.lightfield.aperture import (
    Aperture,
    ShownContrast,
    SlicesThroughStop,
    UsedAperture,
    angular_frequencies,
    shift_shown,
    transfer,
    used_aperture,
)
from dappled.decode.lightfield.views import Views, chroma_noise, from_slices
from dappled.decode.optics import Carrier, Order
from dappled.findings import FRAME, Code, Finding, finding

ViewsModel = Literal["joint", "independent"]
# Chosen by hand where no figure stands beside a number; benchmarks/views.py measures what all of them together make.

_REACH = 1.0  # samples of a slice from view to view: a carrier's order further, and parallax can't be told apart
_LEAST_TRANSFER = 1e-3  # of the whole light: a carrier that the mask doesn't make tells nothing
_MOST_BEYOND = 0.1  # of a frame may be beyond the widest range
_TOLD_BEYOND = 0.005  # of a frame is told
_TOLD_CONTRADICTED = 0.1  # frames of opaque boards with fine detail have up to 0.065
_MOST_VIEWS = 5  # along an axis: with more, the outer ones move by more than a patch can tell, and nobody measured it
# Clipping bends the mask's waves, so that light gets into other orders: in clipped patches as much as in the mean of
# the frame. Measured at half the ideal aperture, where weak orders decide: without it views lose up to 4.5 dB there.
_ASTRAY = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class FrameViews:
    """`views` float32 (V, U, h, w), by which model they were made, and their standard errors `sigma` float32
    (V, U, m, n), see `JointViews`, in the plane's unit; None where the model tells none. `findings` say
    what may be wrong with them, `reason` why the joint model did not make them: None where it did, or was not asked to;
    `shares` how it made which patches, None where it did not.
    """

    views: Views
    model: ViewsModel
    sigma: Singles | None
    findings: tuple[Finding, ...] = ()
    reason: Finding | None = None
    shares: PatchShares | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TakenSlices:
    """Slices complex64 (K, h, w), DC first, cut at `carriers`, and how they were taken (see `views.from_slices`).

    `samples_px` are the rows and columns of the sensor in a sample of a slice, `row_over_column` the height of a pixel
    over its width, `noise_variance` that of a slice's pixel, `unexplained` as in `UsedAperture`,
    `clipped` (m, n) which patches of the joint model hold clipped pixels; None: none.
    """

    values: NDArray[np.complex64]
    carriers: Sequence[Carrier]
    transfers: NDArray[np.complex128]
    kappa_cycles: float
    rotation_rad: float
    aperture: Aperture
    samples_px: tuple[float, float]
    row_over_column: float
    noise_variance: float
    colours: bool
    clipped: NDArray[np.bool_] | None = None
    unexplained: float = 0.0

    def width(
        self,
        *,
        distance_known: bool,
        texture: ShownContrast | None = None,
        faded: Sequence[bool] = (False, True),
    ) -> UsedAperture:
        """The aperture that the slices' means show; `texture` and `faded` as in `used_aperture`."""
        return used_aperture(self._told, distance_known=distance_known, texture=texture, faded=faded)

    def shift(self, *, distance_known: bool) -> tuple[float, float]:
        """By how many periods the slices' means show the mask to have moved."""
        return shift_shown(self._told, distance_known=distance_known)

    @property
    def _told(self) -> SlicesThroughStop:
        at = self.kappa_cycles, self.rotation_rad, self.aperture
        return SlicesThroughStop(self.values, self.transfers, self.orders, *at)

    def moved(self, periods: tuple[float, float]) -> TakenSlices:
        """The same, of a mask that has moved by so many periods."""
        turns = transfer(self.orders, np.ones(len(self.orders)), periods)
        return replace(self, transfers=self.transfers * turns)

    def through(self, width: UsedAperture) -> TakenSlices:
        """The same, taken through this aperture, with a shadow of its contrast."""
        return replace(
            self,
            transfers=np.where(np.arange(len(self.transfers)) > 0, width.contrast, 1.0) * self.transfers,
            kappa_cycles=width.kappa,
            aperture=width.aperture,
            unexplained=width.unexplained,
        )

    def used_transfers(self) -> NDArray[np.complex128]:
        """(K,) T_k, 0 where a slice carries no information: the mask doesn't make its carrier."""
        return np.where(np.abs(self.transfers) > _LEAST_TRANSFER, self.transfers, 0)

    def used(self) -> TakenSlices:
        """The same without those."""
        kept = self.used_transfers() != 0
        if kept.all():
            return self
        carriers = [c for c, usable in zip(self.carriers, kept, strict=True) if usable]
        return replace(self, values=self.values[kept], carriers=carriers, transfers=self.transfers[kept])

    @property
    def orders(self) -> list[Order]:
        """(ky, kx) of each slice."""
        return [(c.ky, c.kx) for c in self.carriers]

    @property
    def angular(self) -> Floats:
        """(K, 2) cycles over the aperture."""
        return angular_frequencies(self.orders, self.kappa_cycles, self.rotation_rad)

    @property
    def samples(self) -> tuple[float, float]:
        """Rows and columns in a sample, both in columns of the sensor."""
        return self.samples_px[0] * self.row_over_column, self.samples_px[1]

    @property
    def reach(self) -> float:
        """The largest usual disparity in sensor columns over the aperture."""
        return _REACH * self.aperture.views * self.samples_px[1]

    def model(self) -> SliceModel:
        """What the slices hold of a scene at one disparity."""
        frequencies = np.array([(c.fy / self.row_over_column, c.fx) for c in self.carriers])
        return SliceModel.of_half(self.orders, self.transfers, self.angular, frequencies, self.aperture)

    def astray(self) -> Floats | None:
        """(m·n,) the share of a patch's light that gets into each order; None: none."""
        if self.clipped is None:
            return None
        return np.where(self.clipped.ravel(), _ASTRAY * self.unexplained, 0.0)

    def noise(self) -> Floats:
        """(K,) variances of slice pixels, chroma included."""
        white = np.full(len(self.values), self.noise_variance)
        if not self.colours:
            return white
        return white + chroma_noise(self.values, self.transfers * self.aperture.transform(self.angular))


def search_of(
    taken: TakenSlices, changes: Floats, steps_px: tuple[float, float], *, workers: int = 1
) -> PlaceSearch | None:
    """What looks for the mask by slices; None where the joint model is not for them."""
    if _unfit(len(taken.carriers), (taken.values.shape[1], taken.values.shape[2]), taken.aperture.views):
        return None
    return PlaceSearch(
        taken.values, taken.model(), taken.samples, taken.noise(), taken.reach, changes, steps_px, workers
    )


def witness_of(taken: TakenSlices, *, workers: int = 1) -> MaskWitness | None:
    """What tells whether slices taken so show the mask; None where the joint model is not for them."""
    if _unfit(len(taken.carriers), (taken.values.shape[1], taken.values.shape[2]), taken.aperture.views):
        return None
    height, width = taken.values.shape[1:]
    return MaskWitness.of((height, width), taken.model(), samples_px=taken.samples, reach=taken.reach, workers=workers)


def views_of(taken: TakenSlices, *, joint: bool, workers: int = 1) -> FrameViews:
    """The views of slices.

    With `joint` views are made by the joint model, unless slices are smaller than a patch, there are more views than it
    was measured with or fewer orders than views have, or disparities are beyond the widest range.
    """
    if not joint:
        return _inverted(taken)
    if unfit := _unfit(len(taken.carriers), (taken.values.shape[1], taken.values.shape[2]), taken.aperture.views):
        return _inverted(taken, reason=unfit)
    found = joint_views(
        taken.values,
        taken.model(),
        samples_px=taken.samples,
        noise=taken.noise(),
        reach=taken.reach,
        astray=taken.astray(),
        workers=workers,
    )
    shares = found.shares
    doubts: tuple[Finding, ...] = ()
    if shares.beyond > _TOLD_BEYOND:
        px, views = FARTHEST * taken.samples_px[1], taken.aperture.views
        doubts = (finding(Code.VIEWS_OUT_OF_REACH, FRAME, share=shares.beyond, px=px, views=views),)
    if shares.beyond > _MOST_BEYOND:  # inverting supposes no range
        return _inverted(taken, doubts, finding(Code.VIEWS_BEYOND_MODEL, FRAME, share=shares.beyond))
    if shares.contradict > _TOLD_CONTRADICTED:
        doubts += (finding(Code.VIEWS_CONTRADICTED, FRAME, share=shares.contradict),)
    return FrameViews(found.views, "joint", found.sigma, doubts, shares=shares)


def _inverted(taken: TakenSlices, doubts: tuple[Finding, ...] = (), reason: Finding | None = None) -> FrameViews:
    """The views of slices, each frequency alike."""
    views = from_slices(
        taken.values,
        taken.angular,
        taken.transfers,
        aperture=taken.aperture,
        noise_variance=taken.noise_variance,
        colours=taken.colours,
    )
    return FrameViews(views, "independent", None, doubts, reason)


def _unfit(orders: int, shape: tuple[int, int], views: int) -> Finding | None:
    """Why the joint model is not for a frame of so many orders and views, with slices of this shape; None where it
    is."""
    if views > _MOST_VIEWS:
        return finding(Code.VIEWS_TOO_MANY, FRAME, views=views, most=_MOST_VIEWS)
    if (needed := (views**2 + 1) // 2) > orders:
        return finding(Code.VIEWS_FEW_CARRIERS, FRAME, carriers=orders, needed=needed)
    if min(shape) < SIDE:
        return finding(Code.VIEWS_SLICES_SMALL, FRAME, height_px=shape[0], width_px=shape[1], patch_px=SIDE)
    return None
