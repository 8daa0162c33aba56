"""Decode planes of a masked camera to slices and views, and report which carriers were used and why.

A decoder is a value: it holds what is common to all frames of a camera, and no data of a single frame. The same plane
gives the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from dappled import codec
from dappled.decode.array_types import Singles
from dappled.decode.calibration.calibration import Calibration, LatticeFit, moved
from dappled.decode.calibration.testimony import LatticeChange, lattice_change
from dappled.decode.errors import DecodeError
from dappled.decode.joint.clipping import clipped_shares, unclipped
from dappled.decode.joint.frame_views import TakenSlices, views_of, witness_of
from dappled.decode.joint.mask_place import MaskPlace, MaskWitness, carrier_changes
from dappled.decode.joint.placed import placed
from dappled.decode.lightfield.aperture import (
    Aperture,
    UsedAperture,
    angular_frequencies,
    at_corner,
    kappa,
    own_transfer,
    shown_aperture,
    transfer,
)
from dappled.decode.lightfield.light_field import LightField, no_views
from dappled.decode.lightfield.views import Views
from dappled.decode.mask_odds import SEEN_NATS
from dappled.decode.optics import MaskedOptics
from dappled.decode.optics.carriers import Carrier, Lattice
from dappled.decode.optics.visibility import designs
from dappled.decode.spectrum.lineariser import LinearRows
from dappled.decode.spectrum.peaks import (
    ALONE_NATS,
    STRONG,
    STRONGER,
    Measured,
    displaced,
    farther_lattice,
    measure,
    own_lattice,
    turn_between,
)
from dappled.decode.spectrum.slices import BandShape, Slices, extract
from dappled.decode.spectrum.transform import Source, Spectrum, SpectrumBuffers, noise_rms, padded_shape, transform
from dappled.findings import FRAME, Code, Finding, finding

CarriersFrom = Literal["measured", "calibrated", "predicted", "found"]
ViewsFrom = Literal["calibration", "frame", "white", "none"]
_ROTATION = 0.04  # of a carrier's frequency: the search without a calibration allows for 2.3°
_UNKNOWN: Mapping[str, Any] = {
    **dict.fromkeys(("transfers", "aperture", "f_number_shown", "f_number_shown_sigma")),
    **dict.fromkeys(("views_model", "views_reason", "views_shares", "mask_place")),
    "view_sigma": None,
    "views_unclipped": False,
}
_Seen = tuple[str, Lattice, float, float]
_BY_CHANCE = 3  # carriers, with the mean, that a scene may seem to show
_CARRIERS_NATS = 20.0  # that the mask is there, where more carriers than by chance are seen
_LEAST_CLIPPED = 1e-4  # of the pixels: defects are fewer
_UNLIKE = frozenset({Code.APERTURE_DISAGREES, Code.APERTURE_UNEXPLAINED})
_ONLY_NOISE = 1.15  # of the noise's variance: frames of noise alone have 0.97 to 1.02
_LEAST_THROUGH = 0.1  # of a carrier: where the aperture leaves less, the mask's transfer can't be measured


@dataclass(frozen=True, slots=True, eq=False)
class MadeViews:
    """Views with their offsets, and where their phases came from.

    `facts` say what each slice is of the light field: `transfers`, rows [ωv, ωu, Re T, Im T], T = 0 where a slice was
    not used, and the `aperture` that it was taken through (see `Aperture.shape`). `findings` say what may be wrong with
    aperture and views, `moved` how far the mask lies from its calibration, `nats` the log odds that it is there.
    """

    values: Views
    offsets: NDArray[np.float64]
    source: ViewsFrom = "none"
    facts: Mapping[str, Any] = field(default_factory=lambda: _UNKNOWN)
    findings: tuple[Finding, ...] = ()
    moved: tuple[Finding, ...] = ()
    nats: float | None = None


@dataclass(frozen=True, slots=True)
class DecodeReport:
    """Which carriers a frame was decoded at, and why.

    `predicted` are the half plane's carriers on the sensor as predicted, (0, 0) first, `measured` what was seen near
    each (None: nothing there), `used` those that the slices were cut at. `carriers_from`: "measured" in this frame;
    "calibrated": predicted by the calibration, as too few were seen; "predicted": by the law alone; "found": an
    unknown lattice found in the frame. `views_from`: whose phases and transfer made the views. `noise_rms` is the
    plane's white noise, 1.0 = sensor white. `findings` say what is unusual about mask, aperture and views, `mask_nats`
    the log odds that the mask is where it was calibrated; None: nothing tells.
    """

    predicted: tuple[Carrier, ...]
    measured: tuple[Measured | None, ...]
    used: tuple[Carrier, ...]
    carriers_from: CarriersFrom
    views_from: ViewsFrom
    noise_rms: float
    findings: tuple[Finding, ...] = ()
    mask_nats: float | None = None

    @property
    def found(self) -> int:
        """How many carriers were seen, the mean (0, 0) included; suspect ones don't count."""
        return sum(m is not None and not m.suspect for m in self.measured)

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """What is unusual about carriers, mask, aperture and views."""
        place = displaced(self.used, self.predicted) if self.carriers_from == "measured" else None
        return self.findings if place is None else (place, *self.findings)


def light_field(
    slices: Slices,
    views: Views,
    offsets: NDArray[np.float64],
    *,
    shape: tuple[int, ...],
    report: DecodeReport,
    facts: Mapping[str, Any],
    view_sigma: NDArray[np.float32] | None = None,
) -> LightField:
    """The light field, with the facts and the numbers and words of the report as its attributes."""
    rows = np.array([(c.ky, c.kx, c.fy, c.fx) for c in slices.carriers], dtype=np.float64)
    attributes = {
        "shape": [int(side) for side in shape],
        **facts,
        "carriers_from": report.carriers_from,
        "views_from": report.views_from,
        "carriers_predicted": len(report.predicted),
        "carriers_found": report.found,
        "noise_rms": report.noise_rms,
    }
    return LightField(slices.values, rows, views, offsets, slices.grid, attributes, view_sigma)


class Decoder(Protocol):
    """A decoder of the planes of one camera."""

    def decode(
        self, plane: Source, *, focal_length_mm: float | None = None, f_number: float | None = None
    ) -> LightField:
        """The light field of a plane float32 (H, W), or of an exposure. Raises DecodeError."""

    def decode_reported(
        self, plane: Source, *, focal_length_mm: float | None = None, f_number: float | None = None, views: bool = True
    ) -> tuple[LightField, DecodeReport]:
        """`decode`, and which carriers it used; without `views` only the slices."""


@dataclass(frozen=True, slots=True, eq=False)
class MaskDecoder:
    """Decodes frames from behind a printed mask. The carriers are predicted by the calibration, or else by the law.
    Where enough of them are seen near the prediction, the frame's own lattice is used.
    `focal_sigma_mm` is the error of the focal length (half of the EXIF rounding), which widens the search. `size` of
    the slices in bins of the padded transform; None: as large as the spacing allows. Views need a calibration, or a
    frame that shows its carriers; else only the slices are there, and `views` has the shape (0, 0, h, w). `colours`
    says that the planes are colour mosaics. `taper` apodises the bands, see `slices.extract`. `at` is this frame's own
    lattice where a search has found it, `ratio` the matrix, row by row, of the lattice found in a flight over the
    law's: a print scaled and turned. Without `joint_views` the views are made quickly, each spatial frequency alike
    (see `views`): depth is computed from slices and needs no better ones. `clipped` (H, W) is 1 where this frame's
    pixels are clipped, else 0; None: nowhere. `buffers` are reused from frame to frame, as is the one in
    `witnesses`, of the last law, lattice, focal length and f-number.
    """

    optics: MaskedOptics
    calibration: Calibration | None = None
    size: tuple[int, int] | None = None
    aperture: Aperture | None = None
    focal_sigma_mm: float = 0.05
    workers: int = 1
    colours: bool = False
    taper: float = 0.0
    at: Lattice | None = None
    ratio: tuple[float, float, float, float] | None = None
    joint_views: bool = True
    clipped: Singles | None = None
    buffers: SpectrumBuffers = field(default_factory=SpectrumBuffers, repr=False)
    witnesses: dict[_Seen, tuple[TakenSlices, MaskWitness] | None] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Raises DecodeError for another camera's calibration."""
        known = self.calibration
        if known is not None and (known.mask != self.optics.mask or known.law != self.optics.law):
            raise DecodeError(
                "the calibration was made with another mask or law: calibrate again, or choose that mask and law"
            )
        if known is not None and known.shape != self.optics.sensor.shape:
            raise DecodeError(
                f"the calibration is for frames of {known.shape}, this camera's are {self.optics.sensor.shape}"
            )

    def lattice_at(self, focal_length_mm: float) -> Lattice:
        """The predicted lattice."""
        if self.calibration is not None:
            return self.calibration.lattice_at(focal_length_mm)
        lattice = self.optics.lattice(focal_length_mm)
        if self.ratio is None:
            return lattice
        return Lattice.of(np.reshape(self.ratio, (2, 2)) @ lattice.matrix())

    def predict(self, focal_length_mm: float) -> list[Carrier]:
        """The half plane's carriers that lie on the sensor, (0, 0) first."""
        return [c for c in self.lattice_at(focal_length_mm).carriers(self.optics.mask.half_orders()) if c.on_sensor]

    def decode(
        self, plane: Source, *, focal_length_mm: float | None = None, f_number: float | None = None
    ) -> LightField:
        """The light field of a plane float32 (H, W) of the sensor's shape, 1.0 = sensor white."""
        return self.decode_reported(plane, focal_length_mm=focal_length_mm, f_number=f_number)[0]

    def decode_reported(
        self, plane: Source, *, focal_length_mm: float | None = None, f_number: float | None = None, views: bool = True
    ) -> tuple[LightField, DecodeReport]:
        """`decode`, and which carriers it used. Without `views`, or an f-number, only the slices are made."""
        if focal_length_mm is None:
            raise DecodeError("the frame's focal length is unknown: give it with --focal-length")
        if not (focal_length_mm > 0 and (f_number is None or f_number > 0)):
            raise DecodeError(f"focal length {focal_length_mm} mm and f-number {f_number} must be above 0")
        if plane.shape != self.optics.sensor.shape:
            raise DecodeError(
                f"the frame is {plane.shape} px, this camera's are {self.optics.sensor.shape}: choose its profile"
            )
        predicted = self.predict(focal_length_mm)
        if len(predicted) < 2:
            raise DecodeError(
                f"all carriers but the mean fall off the sensor at {focal_length_mm} mm: "
                "check mask, law and focal length"
            )
        with self.buffers.lend(self.optics.sensor.shape) as tiles:
            reach = self.largest_fx(focal_length_mm)
            spectrum = transform(plane, tiles=tiles, workers=self.workers, largest_fx=reach)
            lattice, measured, carriers_from = self.locate(spectrum, focal_length_mm, predicted)
            used = [c for c in lattice.carriers([(c.ky, c.kx) for c in predicted]) if c.on_sensor]
            size = self.slice_size(lattice)
            needed = max(abs(c.fx) for c in used) + (size[1] / 2 + 1) / spectrum.padded[1]
            if reach < min(0.5, needed):  # a lattice found at the edge of the search
                spectrum = transform(plane, tiles=tiles, workers=self.workers, largest_fx=min(0.5, needed))
            slices = extract(spectrum, used, BandShape(size, taper=self.taper), workers=self.workers)
            noise = noise_rms(spectrum)
        few = carriers_from == "calibrated" and sum(one is not None for one in measured) <= _BY_CHANCE
        if views:
            made = self.views(
                slices,
                lattice,
                carriers_from,
                focal_length_mm=focal_length_mm,
                f_number=f_number,
                noise_rms=noise,
                plane=plane,
            )
        else:
            nats = (
                None
                if f_number is None or not few
                else self._witnessed(slices, lattice, focal_length_mm, f_number, noise)
            )
            made = MadeViews(*no_views(slices.values.shape[1:]), nats=nats)
        place = made.moved or self._moved(slices, lattice, focal_length_mm)
        if few:
            if np.var(slices.values[0].real) < _ONLY_NOISE * noise**2 * slices.band:
                place = (finding(Code.FRAME_ONLY_NOISE, FRAME),)
            elif made.nats is not None and made.nats <= SEEN_NATS:
                place = (finding(Code.MASK_UNSEEN, FRAME, nats=made.nats),)
        if carriers_from == "measured" and any(one.code in _UNLIKE for one in made.findings):
            change = self.change(spectrum, focal_length_mm, predicted, measured)  # the cause, rather than the aperture
            place = place if change is None else (change.finding, *place)
        report = DecodeReport(
            tuple(predicted),
            tuple(measured),
            tuple(used),
            carriers_from,
            made.source,
            noise,
            (*place, *made.findings),
            made.nats if few or self.calibration is None else _CARRIERS_NATS,
        )
        facts: dict[str, Any] = {
            "law": self.optics.law,
            "focal_length_mm": focal_length_mm,
            "f_number": f_number,
            "mask_distance_mm": self._distance(focal_length_mm),
            "calibrated": self.calibration is not None,
            "padded": list(spectrum.padded),
            "level": spectrum.level,
            "band": list(size),
            "taper": self.taper,
            **made.facts,
        }
        sigma = made.facts["view_sigma"]
        if sigma is not None:
            facts["view_sigma"] = np.sqrt(np.mean(sigma**2, axis=(2, 3))).tolist()
        field = light_field(
            slices, made.values, made.offsets, shape=plane.shape, report=report, facts=facts, view_sigma=sigma
        )
        return field, report

    def transform(self, plane: Source, focal_length_mm: float) -> Spectrum:
        """The spectrum up to the largest frequency that slices and searches need at this focal length."""
        return transform(plane, workers=self.workers, largest_fx=self.largest_fx(focal_length_mm))

    def largest_fx(self, focal_length_mm: float) -> float:
        """The largest frequency along columns that slices and searches need, in cycles/pixel."""
        predicted = self.predict(focal_length_mm)
        wide = padded_shape(self.optics.sensor.shape)[1]
        turned = 0.0 if self._placed else _ROTATION
        longer = self.lattice_at(focal_length_mm + self.focal_sigma_mm).carriers([(c.ky, c.kx) for c in predicted])
        reach = max(abs(c.fx) * (1 + turned) + abs(c.fx - far.fx) for c, far in zip(predicted, longer, strict=True))
        width = self.slice_size(self.lattice_at(focal_length_mm))[1]
        return min(0.5, reach + (max(width / 2, max(self.radii(predicted, focal_length_mm)) + 8) + 2) / wide)

    def slice_size(self, lattice: Lattice) -> tuple[int, int]:
        """(height, width) of the bands in bins of the padded transform."""
        return self.size or lattice.slice_size(padded_shape(self.optics.sensor.shape))

    def locate(
        self, spectrum: Spectrum, focal_length_mm: float, predicted: Sequence[Carrier]
    ) -> tuple[Lattice, list[Measured | None], CarriersFrom]:
        """The lattice to use, what was measured near each predicted carrier, and where the lattice came from."""
        if self.at is not None:
            there = self.at.carriers([(c.ky, c.kx) for c in predicted])
            return self.at, measure(spectrum, there, 1.0, prominence_nats=ALONE_NATS), "measured"
        lattice = self.lattice_at(focal_length_mm)
        measured = measure(spectrum, predicted, self.radii(predicted, focal_length_mm))
        least = STRONGER if self._placed else STRONG
        own = own_lattice(spectrum, predicted, measured, least)
        if own is None and self.calibration is not None:
            change = self.change(spectrum, focal_length_mm, predicted, measured)
            if change is None:
                return lattice, measured, "calibrated"
            own = change.of(lattice)
        if own is None and self.ratio is not None:
            return lattice, measured, "predicted"
        own = own or farther_lattice(spectrum, predicted)
        if own is None:
            # Wide searches also find the period of a fence or a roof: peaks on no common lattice are no carriers.
            kept = [
                m if m is not None and (m.suspect or (c.ky, c.kx) == (0, 0)) else None
                for c, m in zip(predicted, measured, strict=True)
            ]
            return lattice, kept, "predicted"
        at_own = measure(spectrum, own.carriers([(c.ky, c.kx) for c in predicted]), 2.0)
        return own, at_own, "measured"

    def change(
        self,
        spectrum: Spectrum,
        focal_length_mm: float,
        predicted: Sequence[Carrier],
        measured: Sequence[Measured | None],
    ) -> LatticeChange | None:
        """How a frame's carriers together contradict the calibration; None where they don't, or there is none."""
        if self.calibration is None:
            return None
        return lattice_change(spectrum, predicted, measured, self.calibration.nearest(focal_length_mm).residual_bins)

    def radii(self, carriers: Sequence[Carrier], focal_length_mm: float) -> list[float]:
        """How far from each prediction a carrier may lie, in bins: rotation, rounding of the focal length, 1.5 bins."""
        high, wide = padded_shape(self.optics.sensor.shape)
        orders = [(c.ky, c.kx) for c in carriers]
        longer = self.lattice_at(focal_length_mm + self.focal_sigma_mm).carriers(orders)
        spacing = min(math.hypot(v[0] * high, v[1] * wide) for v in self.lattice_at(focal_length_mm).matrix())
        turned = 0.0 if self._placed else _ROTATION
        return [
            min(
                1.5
                + math.hypot((a.fy - b.fy) * high, (a.fx - b.fx) * wide)
                + turned * math.hypot(a.fy * high, a.fx * wide),
                0.4 * spacing,
            )
            for a, b in zip(carriers, longer, strict=True)
        ]

    @property
    def _placed(self) -> bool:
        """Whether frames have shown before where the mask is: turn and scale are known."""
        return self.calibration is not None or self.ratio is not None

    def _distance(self, focal_length_mm: float) -> float:
        if self.calibration is not None:
            return self.calibration.nearest(focal_length_mm).mask_distance_mm
        return self.optics.distance_mm

    def _moved(self, slices: Slices, lattice: Lattice, focal_length_mm: float) -> tuple[Finding, ...]:
        """How far the frame's slices show the mask from where the calibration has it."""
        if self.calibration is None:
            return ()
        orders = [(c.ky, c.kx) for c in slices.carriers]
        return self.calibration.mask_move(
            slices.values,
            orders,
            focal_length_mm=focal_length_mm,
            lattice=lattice,
            samples_px=(float(slices.grid[0, 0]), float(slices.grid[1, 1])),
        ).findings(self.optics.mask.frequency_per_mm)

    def views(
        self,
        slices: Slices,
        lattice: Lattice,
        carriers_from: CarriersFrom,
        *,
        focal_length_mm: float,
        f_number: float | None,
        noise_rms: float,
        plane: Source | None = None,
    ) -> MadeViews:
        """Views of slices that were cut before. With a calibration and their `plane`, slices of a mask that has turned
        since, or is of another scale, are cut again for them; else clipped pixels count as what is around them tells.
        """
        none = MadeViews(*no_views(slices.values.shape[1:]))
        if f_number is None:
            return none
        taken = self._taken(slices, focal_length_mm, f_number, noise_rms)
        cycles = taken.kappa_cycles
        width: UsedAperture | None = None
        place, told = None, False
        if self.calibration is not None:
            known = self.calibration.nearest(focal_length_mm)
            turn = turn_between(lattice, self.lattice_at(focal_length_mm))
            found = self._calibrated(taken, lattice, known, turn)
            far = found[2] and found[2].far()
            if plane is not None and far and (far.turn_rad or far.off):
                found = self._cut_again(taken, far, plane, lattice=lattice, known=known, turn_rad=turn) or found
            elif plane is not None and self._clips and found[1].fits:
                taken = replace(taken, values=self._unclipped(found[0], plane, lattice))
                again = self._calibrated(taken, lattice, known, turn)
                found, told = (again, True) if again[1].fits else (found, False)
            taken, width, place = found
            views_from: ViewsFrom = "calibration"
        elif carriers_from == "measured":
            rotation = turn_between(lattice, self.lattice_at(focal_length_mm))
            drawn = designs(self.optics, lattice, f_number, taken.orders)
            width = shown_aperture(
                slices.values,
                drawn,
                taken.orders,
                nominal_kappa=cycles,
                rotation_rad=rotation,
                aperture=taken.aperture,
            )
            taken = taken.through(width)
            through = taken.aperture.transform(angular_frequencies(taken.orders, width.kappa, rotation)).real
            keep = np.abs(through) > _LEAST_THROUGH
            if np.linalg.matrix_rank([order for order, usable in zip(taken.orders, keep, strict=True) if usable]) < 2:
                return none
            transfers = own_transfer(slices.values, taken.orders, through, keep)
            taken = replace(taken, transfers=np.where(keep, transfers, 0), rotation_rad=rotation)
            views_from = "frame"
        else:
            return none
        shown, shown_sigma = self._shown(width, f_number * cycles, focal_length_mm)
        fits = width is None or width.fits  # the joint model trusts the aperture
        made = views_of(taken.used(), joint=self.joint_views and fits, workers=self.workers)
        used = taken.used_transfers()
        facts = {
            "transfers": np.column_stack([taken.angular, used.real, used.imag]).tolist(),
            "aperture": taken.aperture.shape,
            "f_number_shown": shown,
            "f_number_shown_sigma": shown_sigma,
            "views_model": made.model,
            "views_reason": codec.plain(made.reason if fits else finding(Code.VIEWS_APERTURE_UNKNOWN, FRAME)),
            "views_shares": codec.plain(made.shares),
            "view_sigma": made.sigma,
            "views_unclipped": told,
            "mask_place": codec.plain(place),
        }
        strange = None if width is None else width.finding(f_number)
        return MadeViews(
            made.views,
            taken.aperture.offsets(),
            views_from,
            facts,
            made.findings if strange is None else (strange, *made.findings),
            () if place is None else self._away(place),
            None if place is None else place.nats,
        )

    def _taken(self, slices: Slices, focal_length_mm: float, f_number: float, noise_rms: float) -> TakenSlices:
        """How slices were taken, with transfers of 1."""
        printed = self.optics.mask.frequency_per_mm
        if self.calibration is not None:
            printed *= self.calibration.nearest(focal_length_mm).print_scale
        cycles = kappa(printed, self._distance(focal_length_mm), focal_length_mm, f_number)
        across, down = math.hypot(*self.optics.sensor.column_mm), math.hypot(*self.optics.sensor.row_mm)
        return TakenSlices(
            slices.values,
            slices.carriers,
            np.ones(len(slices.carriers), dtype=np.complex128),
            kappa_cycles=cycles,
            rotation_rad=0.0,
            aperture=self.aperture or Aperture(self.optics.mask.views_per_axis),
            samples_px=(float(np.hypot(*slices.grid[:, 0])), float(np.hypot(*slices.grid[:, 1]))),
            row_over_column=down / across,
            noise_variance=noise_rms**2 * slices.band,
            colours=self.colours,
            clipped=None
            if self.clipped is None
            else clipped_shares(self.clipped, slices.values.shape[1:], slices.grid) > 0,
        )

    def _witnessed(
        self, slices: Slices, lattice: Lattice, focal_length_mm: float, f_number: float, noise_rms: float
    ) -> float | None:
        """The log odds that slices show the mask in its place; None where nothing tells."""
        assert self.calibration is not None
        through_this = self.optics.law, lattice, focal_length_mm, f_number
        taken = self._taken(slices, focal_length_mm, f_number, noise_rms)
        if through_this not in self.witnesses:
            known = self.calibration.nearest(focal_length_mm)
            turn = turn_between(lattice, self.lattice_at(focal_length_mm))
            through = replace(self, joint_views=False)._calibrated(taken, lattice, known, turn)[0]
            witness = witness_of(through.used(), workers=self.workers)
            self.witnesses.clear()  # one has 20 MB, and a lens that zooms would leave one at each length
            self.witnesses[through_this] = (
                None if witness is None else (replace(through, values=through.values[:, :0]), witness)
            )
        kept = self.witnesses[through_this]
        if kept is None:
            return None
        used = replace(kept[0], values=slices.values, noise_variance=taken.noise_variance).used()
        return kept[1].nats(used.values, used.noise(), self.workers)

    @property
    def _clips(self) -> bool:
        return self.joint_views and self.clipped is not None and float(self.clipped.mean()) > _LEAST_CLIPPED

    def _cut_again(
        self,
        taken: TakenSlices,
        far: MaskPlace,
        plane: Source,
        *,
        lattice: Lattice,
        known: LatticeFit,
        turn_rad: float,
    ) -> tuple[TakenSlices, UsedAperture, MaskPlace | None] | None:
        """As `_calibrated`, by slices that are cut where a turn and a scale put the carriers; None where the mask isn't
        seen there, or carriers are off the sensor."""
        there = far.change.of(lattice)
        carriers = there.carriers(taken.orders)
        if not all(one.on_sensor for one in carriers):
            return None
        size = self.slice_size(lattice)
        with self.buffers.lend(self.optics.sensor.shape) as tiles:
            spectrum = transform(plane, tiles=tiles, workers=self.workers)
            values = extract(spectrum, carriers, BandShape(size, taper=self.taper), workers=self.workers).values
        taken = replace(taken, values=values, carriers=carriers)
        at, width, place = self._calibrated(taken, there, known, turn_rad + turn_between(there, lattice))
        if place is None or not place.seen:
            return None
        return at, width, place.beyond((0.0, 0.0), far.turn_rad, far.off)

    def _unclipped(self, taken: TakenSlices, plane: Source, lattice: Lattice) -> NDArray[np.complex64]:
        """The slices of a plane whose clipped pixels are as bright as what is around them tells."""
        assert self.clipped is not None
        whole = plane.plane(self.workers) if isinstance(plane, LinearRows) else plane
        with self.buffers.lend(self.optics.sensor.shape) as tiles:
            spectrum = transform(unclipped(whole, self.clipped, taken), tiles=tiles, workers=self.workers)
            size = self.slice_size(lattice)
            return extract(spectrum, taken.carriers, BandShape(size, taper=self.taper), workers=self.workers).values

    def _calibrated(
        self, taken: TakenSlices, lattice: Lattice, known: LatticeFit, turn_rad: float
    ) -> tuple[TakenSlices, UsedAperture, MaskPlace | None]:
        """The slices with a calibration's transfers, and the aperture that they show; with the joint model, where
        they place the mask, and as a mask in its place would make them."""
        magnitudes = dict(zip(self.optics.mask.half_orders(), known.transfer, strict=True))
        corner = at_corner(known.origin, lattice, self.optics.sensor.shape)
        transfers = transfer(taken.orders, [magnitudes[order] for order in taken.orders], corner)
        taken = replace(taken, transfers=transfers, rotation_rad=known.rotation_rad + turn_rad)
        if not self.joint_views:
            width = taken.width(distance_known=known.distance_fitted)
            return taken.through(width), width, None
        changes = carrier_changes(lattice, self.optics.sensor)
        at, width, place = placed(taken, changes, distance_known=known.distance_fitted, workers=self.workers)
        return at.through(width), width, place

    def _away(self, place: MaskPlace) -> tuple[Finding, ...]:
        """How far off a frame's slices place the mask, as findings."""
        far, printed = place.far(), self.optics.mask.frequency_per_mm
        if not far.off:
            return moved(far.periods, far.turn_rad, printed)
        return place.change.finding, *moved(far.periods, 0.0, printed)

    def _shown(
        self, width: UsedAperture | None, turns: float, focal_length_mm: float
    ) -> tuple[float | None, float | None]:
        """The f-number that the carriers show and its standard error, from the told one times its κ. No error where the
        mask's distance was stated: if that is wrong, so is the f-number."""
        if width is None or not width.fitted or self.calibration is None:
            return None, None
        shown = turns / width.kappa
        known = self.calibration.nearest(focal_length_mm).distance_fitted
        return shown, shown * width.sigma / width.kappa if known else None
