"""Make the picture at the sensor's own resolution of a frame's file, by the recipe that light fields are decoded by."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rawpy

from dappled.config import profiles
from dappled.decode.array_types import Floats
from dappled.decode.decoder import MaskDecoder
from dappled.decode.lightfield.aperture import SHAPES, Aperture, angular_frequencies, kappa, transfer
from dappled.decode.optics import LAWS, MaskedOptics, Sensor
from dappled.decode.optics.shadow_orders import shadow_orders
from dappled.decode.optics.visibility import order_strengths
from dappled.decode.picture.blocks import MosaicPlane
from dappled.decode.picture.picture import DARK, UnmaskedPicture, picture_of
from dappled.decode.picture.shadow import OwnShadow, Shadow, ShadowFrom, period_of
from dappled.decode.picture.shadow_fit import ExpectedShadow, shadow_of, told_by
from dappled.drivers.raw import reading, recipe_check
from dappled.drivers.raw.darkroom import Darkroom, naming
from dappled.drivers.raw.frame_mosaic import mosaic_of
from dappled.drivers.raw.raw_file import MOST_CLIPPED, WHITE_SHARE, RawFile, shares_of_white
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from dappled.findings import Code, Finding, Level, Subject, above_note, finding

_TURNED, _SCALED = 0.03, 0.02  # radians, and of the period: how far a mask may lie from a law's prediction
_TURNED_SINCE, _SCALED_SINCE = 0.02, 0.006  # since its calibration
_DEEP = 0.03  # standard deviation of W: where as much is predicted at least, some must be found
_UNCERTAIN = 0.02  # standard error of W
_TOLD_SIGMA = 0.02  # of a predicted W: f-number and stop
_MANY_DARK = 0.01  # of the pixels
_SURE_NOISE = 0.2  # of the noise's variance: where less is, more pixels lie within one sigma than should
_BESIDE = 8  # frames whose shadows are averaged

_Lens = tuple[float, float | None]
"""Focal length in mm and f-number."""
_Alike = tuple[str | None, tuple[int, int], _Lens, str]
"""Of frames that have one shadow: camera, shape, lens, and the law that predicts it."""


@dataclass(frozen=True, slots=True)
class LensFrame:
    """A frame's file, its focal length and its f-number; None: as the file has them."""

    path: Path
    focal_length_mm: float | None = None
    f_number: float | None = None


def beside(flight: Sequence[LensFrame]) -> dict[LensFrame, tuple[LensFrame, ...]]:
    """The frames to take each frame's shadow from: of those in its folder with its lens and stop, a few from all over
    the flight; the same ones for each of them, so that each is asked once. None for a frame that is alone."""
    alike: dict[tuple[Path, float | None, float | None], list[LensFrame]] = {}
    for one in flight:
        alike.setdefault((one.path.parent, one.focal_length_mm, one.f_number), []).append(one)
    chosen: dict[LensFrame, tuple[LensFrame, ...]] = {}
    for same in alike.values():
        at = np.unique(np.linspace(0, len(same) - 1, _BESIDE).round())
        few = tuple(same[int(number)] for number in at) if len(same) > 1 else ()
        chosen |= dict.fromkeys(same, few)
    return chosen


@dataclass(frozen=True, slots=True, eq=False)
class ToldShadow:
    """What a frame tells of its shadow to those of the same camera, lens and stop (`alike`): a small value, which goes
    from process to process."""

    path: Path
    alike: _Alike
    own: OwnShadow


@dataclass(frozen=True, slots=True, eq=False)
class MadePicture:
    """The picture of one file: `raw` is the file's, `sensor` that of the whole frame (a staggered chip's is spread), of
    which `picture` begins at row and column `corner`.
    `colour_matrix` (3, 3) from XYZ to the camera's red, green and blue, None where LibRaw knows none."""

    picture: UnmaskedPicture
    raw: RawFile
    sensor: Sensor
    corner: tuple[int, int]
    focal_length_mm: float
    f_number: float | None
    colour_matrix: Floats | None
    findings: tuple[Finding, ...]

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """What speaks against it."""
        return tuple(above_note(self.findings))


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    path: Path
    raw: RawFile
    mosaic: MosaicPlane
    corner: tuple[int, int]
    decoder: MaskDecoder
    lens: _Lens

    @property
    def alike(self) -> _Alike:
        return self.raw.model, self.mosaic.shape, self.lens, self.decoder.optics.law

    @property
    def expected(self) -> ExpectedShadow:
        """The shadow that is predicted, and how far its lattice is searched."""
        reach = (_TURNED, _SCALED) if self.decoder.calibration is None else (_TURNED_SINCE, _SCALED_SINCE)
        lattice = self.decoder.lattice_at(self.lens[0])
        orders = shadow_orders(_optics(self.decoder, self.lens[0]), lattice, self.lens[1])
        return ExpectedShadow(lattice, *orders, *reach)


class PictureMaker:
    """Makes pictures of frames by one recipe, with `most_px` of their middle alone, at most so many pixels on a side;
    keeps the shadow of its white frame."""

    def __init__(self, recipe: Recipe, most_px: int | None = None) -> None:
        self._darkroom = Darkroom(replace(recipe, white=""))
        self._recipe, self._most_px = recipe, most_px
        self._white: Shadow | None = None

    def check(self) -> None:
        """Raise DappledError when the recipe names something that is missing or wrong, or lenslets."""
        if self._recipe.mask == profiles.LENSLET:
            raise DappledError("a picture of full resolution is made behind printed masks, not behind lenslets")
        recipe_check.check(self._recipe)

    def picture(
        self,
        path: Path | str,
        *,
        focal_length_mm: float | None = None,
        f_number: float | None = None,
        told: Sequence[ToldShadow] = (),
    ) -> MadePicture:
        """The picture of a frame; arguments that are None are taken from its file. `told` is what frames behind the
        same mask (see `beside`) tell of its shadow, it among them or not. Raises DappledError."""
        frame = self._frame(LensFrame(Path(path), focal_length_mm, f_number))
        raw, decoder, lens = frame.raw, frame.decoder, frame.lens
        with naming(path):
            shadow = self._shadow(frame, [one for one in told if one.alike == frame.alike])
            made = picture_of(frame.mosaic, shadow, period_of(shadow.lattice))
        found = self._findings(Subject("frame", str(path)), raw, made, decoder, lens)
        return MadePicture(made, raw, decoder.optics.sensor, frame.corner, *lens, _colour_matrix(path, raw), found)

    def tell(self, one: LensFrame) -> ToldShadow | None:
        """What a frame tells of its shadow; None where it shows none. Raises DappledError."""
        frame = self._frame(one)
        with naming(one.path):
            own = told_by(frame.mosaic, frame.expected, self._known(frame))
        return ToldShadow(one.path, frame.alike, own) if own.seen else None

    def _frame(self, one: LensFrame) -> _Frame:
        raw = self._darkroom.read(one.path)
        focal_length_mm = one.focal_length_mm or raw.focal_length_mm
        if focal_length_mm is None:
            raise DappledError(f"{one.path}: its focal length is unknown: give it with --focal-length")
        with naming(one.path):
            mosaic, corner = self._mosaic(raw)
            shape = mosaic.shape[0] + 2 * corner[0], mosaic.shape[1] + 2 * corner[1]
            decoder = self._darkroom.mask_decoder(shape, raw.model or "")
        return _Frame(one.path, raw, mosaic, corner, decoder, (focal_length_mm, one.f_number or raw.f_number))

    def _mosaic(self, raw: RawFile) -> tuple[MosaicPlane, tuple[int, int]]:
        staggered = self._darkroom.camera(raw.model or "").staggered(raw.mosaic.shape)
        dark = reading.read(Path(self._recipe.dark)).mosaic if self._recipe.dark else None
        return mosaic_of(raw, self._most_px, staggered=staggered, dark=dark)

    def _shadow(self, frame: _Frame, told: Sequence[ToldShadow]) -> Shadow:
        decoder, known = frame.decoder, self._known(frame)
        beside = [one.own.evidence for one in told if one.path != frame.path]
        if own := next((one.own for one in told if one.path == frame.path), None):
            made = own.shadow(known, beside)
        else:
            made = shadow_of(frame.mosaic, frame.expected, known, beside)
        if made.source == ShadowFrom.NONE and self._recipe.try_laws and decoder.calibration is None:
            for law in LAWS:
                there = replace(decoder, optics=decoder.optics.by(law))
                if law != decoder.optics.law and there.predict(frame.lens[0])[1:]:
                    tried = shadow_of(frame.mosaic, replace(frame, decoder=there).expected)
                    made = tried if tried.source != ShadowFrom.NONE else made
        return made

    def _known(self, frame: _Frame) -> list[Shadow]:
        """Shadows that may be a frame's: its white frame's, and those that its calibration predicts."""
        return [*([self._white_shadow(frame)] if self._recipe.white else []), *_calibrated(frame)]

    def _white_shadow(self, frame: _Frame) -> Shadow:
        if self._white is None:
            with naming(self._recipe.white):
                mosaic, _ = self._mosaic(self._darkroom.read(self._recipe.white))
                found = shadow_of(mosaic, replace(frame.expected, turned=_TURNED, scaled=_SCALED))
                self._white = replace(found, source=ShadowFrom.WHITE)
        return self._white

    def _findings(
        self,
        subject: Subject,
        raw: RawFile,
        made: UnmaskedPicture,
        decoder: MaskDecoder,
        lens: _Lens,
    ) -> tuple[Finding, ...]:
        found, shadow = [], made.shadow
        if raw.developed:
            found.append(finding(Code.PICTURE_DEVELOPED, subject, why=raw.developed))
        clipped = float(np.mean(shares_of_white(raw, 1) >= WHITE_SHARE))
        if clipped > MOST_CLIPPED:
            found.append(finding(Code.PICTURE_CLIPPED, subject, share=clipped))
        if shadow.source == ShadowFrom.NONE:
            least = _least_depth(decoder, *lens)
            level = Level.CAUTION if least > _DEEP else Level.NOTE
            found.append(finding(Code.PICTURE_SHADOW_UNSEEN, subject, level, least_depth=least))
        elif float(shadow.sigma.max()) > _UNCERTAIN:
            found.append(finding(Code.PICTURE_SHADOW_UNCERTAIN, subject, sigma=float(shadow.sigma.max())))
        if shadow.unlike > max(shadow.alike, 1):
            of_all = shadow.alike + shadow.unlike
            found.append(finding(Code.PICTURE_SHADOW_DIFFERS, subject, unlike=shadow.unlike, others=of_all))
        if made.dark_share > _MANY_DARK:
            found.append(finding(Code.PICTURE_DARK, subject, share=made.dark_share, below=DARK))
        if made.sure_noise < _SURE_NOISE:
            found.append(finding(Code.PICTURE_NOISE_UNKNOWN, subject, share=made.sure_noise))
        if made.soft_share > 0:
            found.append(finding(Code.PICTURE_SOFT, subject, share=made.soft_share))
        return tuple(found)


def _optics(decoder: MaskDecoder, focal_length_mm: float) -> MaskedOptics:
    """With the mask where its calibration has it."""
    if decoder.calibration is None:
        return decoder.optics
    return replace(decoder.optics, distance_mm=decoder.calibration.nearest(focal_length_mm).mask_distance_mm)


def _least_depth(decoder: MaskDecoder, focal_length_mm: float, f_number: float | None) -> float:
    """The least standard deviation of W that is predicted."""
    found = order_strengths(_optics(decoder, focal_length_mm), decoder.lattice_at(focal_length_mm), f_number)
    return math.sqrt(2 * sum(one.least**2 for one in found if one.on_sensor))


def _calibrated(frame: _Frame) -> list[Shadow]:
    """What a calibration predicts, behind a stop of each shape; none without an f-number."""
    (focal_length_mm, f_number), decoder, mosaic = frame.lens, frame.decoder, frame.mosaic
    if decoder.calibration is None or not f_number:
        return []
    expected = frame.expected
    known = decoder.calibration.nearest(focal_length_mm)
    magnitudes = dict(zip(decoder.optics.mask.half_orders(), known.transfer, strict=True))
    orders = [order for order in expected.orders if order in magnitudes]
    transfers = transfer(orders, [magnitudes[order] for order in orders], known.origin)
    cycles = kappa(
        decoder.optics.mask.frequency_per_mm * known.print_scale, known.mask_distance_mm, focal_length_mm, f_number
    )
    angular = angular_frequencies(orders, cycles, known.rotation_rad)
    made = []
    for shape in SHAPES:
        through = transfers * Aperture(decoder.optics.mask.views_per_axis, shape).transform(angular)
        each = np.repeat(through[None, :, None], mosaic.colours, axis=0)
        sigma = np.full(mosaic.colours, _TOLD_SIGMA)
        made.append(Shadow(mosaic.shape, expected.lattice, tuple(orders), each, 0, ShadowFrom.CALIBRATION, sigma))
    return made


def _colour_matrix(path: Path | str, raw: RawFile) -> Floats | None:
    """LibRaw's matrix of the body, from XYZ to red, green and blue; None where it knows none."""
    if raw.cfa is None:
        return None
    try:
        with rawpy.imread(str(path)) as file:
            matrix = np.asarray(file.rgb_xyz_matrix, dtype=np.float64)[:3]
    except rawpy.LibRawError:
        return None
    return matrix if np.any(matrix) else None
