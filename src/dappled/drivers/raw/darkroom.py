"""Decode a raw file to a light field by a recipe: read it, make it linear, and choose its decoder by profiles."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled import codec
from dappled.config import profiles
from dappled.config.profiles import CameraProfile
from dappled.decode import DecodeError
from dappled.decode.calibration import Calibration
from dappled.decode.calibration.law_search import LawSearch
from dappled.decode.colour_views import dc_views, in_colour
from dappled.decode.decoder import Decoder, DecodeReport, MaskDecoder
from dappled.decode.depth import RANGING
from dappled.decode.joint.clipping import unknown_where_clipped
from dappled.decode.lenslets import MOSAIC_ROLLOFF, LensletDecoder
from dappled.decode.lightfield import LightField
from dappled.decode.lightfield.falloff import Falloff, falloff
from dappled.decode.optics import MaskedOptics
from dappled.decode.spectrum import LinearRows, Plane
from dappled.decode.spectrum import plane as planes
from dappled.decode.spectrum.lineariser import check_shape, lineariser
from dappled.decode.spectrum.plane import Places, colour_index, coloured, find_defects, local_colours, mended, spread
from dappled.decode.spectrum.transform import Source
from dappled.drivers.raw import calibration_files, reading
from dappled.drivers.raw.law_check import FrameLens, LawCheck, check_report
from dappled.drivers.raw.raw_file import (
    MOST_CLIPPED,
    WHITE_SHARE,
    Exposure,
    RawFile,
    exposure,
    not_linear,
    shares_of_white,
)
from dappled.drivers.raw.recipe import LawDecision, Recipe, camera_name
from dappled.errors import DappledError
from dappled.findings import Finding, Subject

Painter = Callable[[LightField], NDArray[np.float32]]  # views in colour of a light field with grey ones


def read(path: Path | str, recipe: Recipe) -> RawFile:
    """Read a frame's file, with the values that the recipe overrides. Raises DappledError."""
    return override(reading.read(Path(path)), recipe)


def override(raw: RawFile, recipe: Recipe) -> RawFile:
    """Replace the values that the recipe gives. Raises DappledError for a wrong colour pattern."""
    changed: dict[str, Any] = {}
    if recipe.cfa:
        side = math.isqrt(len(recipe.cfa))
        pattern = recipe.cfa.upper()
        if side < 2 or side * side != len(pattern) or set(pattern) != set("RGB"):
            raise DappledError(
                f"--cfa {recipe.cfa} is not a colour pattern: give its letters R, G, B row by row, as in BGGR"
            )
        changed["cfa"] = np.array(["RGB".index(letter) for letter in pattern], dtype=np.int64).reshape(side, side)
        changed["colour_names"] = ("R", "G", "B")
        changed["balance"] = None
        if isinstance(raw.black, tuple):
            changed["black"] = max(raw.black)
    if recipe.black is not None:
        changed["black"] = recipe.black
    if recipe.white_level is not None:
        changed["white"] = recipe.white_level
    return replace(raw, **changed) if changed else raw


def camera_profile(recipe: Recipe, model: str) -> CameraProfile:
    """Return the camera's profile: the recipe's, or by model. Raises DappledError where no profile knows the model."""
    if recipe.camera != "auto":
        return profiles.camera(recipe.camera)
    found = profiles.camera_for_model(model)
    if found is None:
        named = f"the frame says {model!r}" if model else "the frame names no camera"
        raise DappledError(f"{named}, and no profile fits it: name one with --camera")
    return found


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Context in which a DecodeError becomes a DappledError with the file's name."""
    try:
        yield
    except DecodeError as error:
        raise DappledError(f"{path}: {error}") from error


@dataclass(frozen=True, slots=True)
class DecodeResult:
    """A decoded frame, its report and raw file, and how many milliseconds each step took.

    `checked` is whether its carriers stand where slices are cut, where that was checked. `calibration_doubts` are
    those about the calibration itself, `exposed` how the file's values are, `not_linear` why they may not follow
    the light in the scene, vignetting among it.
    """

    light_field: LightField
    report: DecodeReport
    raw: RawFile
    exposed: Exposure
    ms: dict[str, float] = field(default_factory=dict)
    checked: LawCheck | None = None
    calibration_doubts: tuple[Finding, ...] = ()
    not_linear: tuple[Finding, ...] = ()

    @property
    def search(self) -> LawSearch | None:
        """What the frame shows under all laws; None where they were not tried."""
        return None if self.checked is None else self.checked.search

    @property
    def contradiction(self) -> Finding | None:
        """Why carriers should be visible and are not, or stand elsewhere; None where there is no such reason."""
        return None if self.checked is None else self.checked.contradiction

    @property
    def unsettled(self) -> Finding | None:
        """What can't be told of the carriers, or is strange about those that are there; None where nothing is."""
        return None if self.checked is None else self.checked.unsettled

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """All that is in doubt about the frame."""
        carriers = (one for one in (self.contradiction, self.unsettled) if one is not None)
        return (*carriers, *self.report.doubts, *self.calibration_doubts, *self.not_linear)

    @property
    def observable(self) -> bool:
        """False where no carrier is seen, and none needs to be at this aperture and in this scene."""
        return self.report.found > 1 or self.contradiction is not None or self.search is None

    @property
    def carriers_found(self) -> int:
        """Carriers seen in the whole plane without the mean: those of the half plane and their conjugates."""
        return 2 * (self.report.found - 1)

    @property
    def carriers_predicted(self) -> int:
        """Carriers predicted on the sensor, counted in the same way."""
        return 2 * (len(self.report.predicted) - 1)


class Darkroom:
    """Decodes frames by one recipe. Makes one decoder for each raw shape and camera, and keeps it."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self._checks = recipe.try_laws or recipe.keep_law
        self._decoders: dict[tuple[tuple[int, int], str, bool], Decoder] = {}
        self._lineariser = FrameLineariser(recipe)

    def decode(
        self,
        path: Path | str,
        *,
        focal_length_mm: float | None = None,
        f_number: float | None = None,
        views: bool = True,
        joint_views: bool = True,
    ) -> DecodeResult:
        """Decode a frame. Arguments that are None are taken from its file. Without `views` only the slices are made,
        without `joint_views` views of less quality, quickly.

        Raises DappledError with the file's name and what is wrong.
        """
        ms: dict[str, float] = {}
        with _timed(ms, "read"):
            raw = self.read(path)
        with naming(path):
            with _timed(ms, "plane"):
                rows, painted = self._lineariser.rows(raw, colour=self.recipe.colour and views)
                plane = self._lineariser.upright(rows, raw)
            decoder = self.decoder(plane.shape, raw.model or "", colours=raw.cfa is not None)
            clipped: Plane | None = None
            if isinstance(decoder, MaskDecoder):
                decoder = known_to(decoder, None if focal_length_mm else raw.focal_sigma_mm)
                if views and joint_views:
                    clipped = self._lineariser.clipped(raw)
                decoder = replace(decoder, joint_views=joint_views, clipped=clipped)
            focal_length_mm = focal_length_mm or raw.focal_length_mm
            f_number = f_number or raw.f_number
            with _timed(ms, "slices and views" if views else "slices"):
                light_field, report = decoder.decode_reported(
                    plane, focal_length_mm=focal_length_mm, f_number=f_number, views=views
                )
                checked: LawCheck | None = None
                if self._checks and isinstance(decoder, MaskDecoder) and focal_length_mm:
                    lens = FrameLens(focal_length_mm, f_number, self._narrowest_f(raw))
                    checked = check_report(decoder, plane, report, lens, keep_law=self.recipe.keep_law)
                    if checked.decoder is not decoder:
                        decoder = checked.decoder
                        light_field, report = decoder.decode_reported(
                            plane, focal_length_mm=focal_length_mm, f_number=f_number, views=views
                        )
                if painted is not None:
                    light_field = replace(light_field, views=painted(light_field))
                if clipped is not None:
                    light_field = unknown_where_clipped(light_field, clipped, MOST_CLIPPED)
        dropped = isinstance(decoder, MaskDecoder) and decoder.calibration is None  # its metres don't hold then
        attributes = {
            **light_field.attributes,
            "camera": self.camera_name(raw.model),
            "mask": self.recipe.mask,
            "decoded_from": "grey" if raw.cfa is None else "mosaic",
            **raw.levels(),
            "corrected_by": [name for name in ("dark", "white") if getattr(self.recipe, name)],
            **(self._ranging if views and not dropped else {}),
        }
        with _timed(ms, "exposure"):
            exposed = exposure(raw)
        bent = not_linear(raw, exposed, masked=isinstance(decoder, MaskDecoder))
        bent += self._lineariser.doubts
        lost = self.lost_at_corners(light_field) if views else None
        if lost is not None and (vignetted := lost.finding()) is not None:
            bent.append(vignetted)
        attributes["falloff"] = None if lost is None else [lost.lost, lost.sigma]
        made = DecodeResult(light_field, report, raw, exposed, ms, checked, doubts_of(decoder), tuple(bent))
        attributes["doubts"] = codec.plain(made.doubts)
        if self._checks and not made.observable:
            attributes["carriers_found"] = None
        return replace(made, light_field=replace(light_field, attributes=attributes))

    def lost_at_corners(self, light_field: LightField) -> Falloff | None:
        """Return what light a frame's corners lose; None for lenslets, with a white frame, and where nothing tells."""
        asked = self.recipe.mask != profiles.LENSLET and not self.recipe.white
        return falloff(light_field.slices[0].real) if asked else None

    def decision(self, made: DecodeResult, index: int) -> LawDecision | None:
        """Return what the search of frame `index` decides for its flight; None where it found nothing."""
        search = made.search
        if search is None or search.found is None or search.law is None:
            return None
        shape, length = made.light_field.attributes["shape"], made.light_field.attributes["focal_length_mm"]
        decoder = self.mask_decoder((shape[0], shape[1]), made.raw.model or "")
        predicted = decoder.optics.by(search.law).lattice(length)
        (a, b), (c, d) = search.found.lattice.matrix() @ np.linalg.inv(predicted.matrix())
        sentence = f"decoded by the law {search.law} from frame {index} on: {search.sentence}"
        return LawDecision(search.law, (float(a), float(b), float(c), float(d)), index, sentence)

    def plane(self, raw: RawFile) -> Plane:
        """Return a frame's linear plane: black, white and dark frame; for masks also even colours and white frame."""
        return self._lineariser.plane(raw)

    def read(self, path: Path | str) -> RawFile:
        """Read a frame's file, with the values that the recipe overrides. Raises DappledError."""
        return read(path, self.recipe)

    def decoder(self, shape: tuple[int, ...], model: str, *, colours: bool = False) -> Decoder:
        """Return the decoder for frames of this shape from this camera; `colours` where they are colour mosaics."""
        key = (shape[0], shape[1]), model, colours
        if key not in self._decoders:
            self._decoders[key] = self._make(*key)
        return self._decoders[key]

    def mask_decoder(self, shape: tuple[int, int], model: str) -> MaskDecoder:
        """Return the decoder of a camera with a printed mask. Raises DappledError for lenslets."""
        decoder = self.decoder(shape, model)
        if not isinstance(decoder, MaskDecoder):
            raise DappledError("lenslets have no mask to predict carriers of")
        return decoder

    def camera(self, model: str) -> CameraProfile:
        """Return the camera's profile: the recipe's, or by model. Raises DappledError."""
        return camera_profile(self.recipe, model)

    def camera_name(self, model: str | None) -> str:
        """Return what tags and headers call the camera: the profile's name, the model, or "unknown"."""
        return camera_name(self.recipe.camera, model)

    def _make(self, shape: tuple[int, int], model: str, colours: bool) -> Decoder:
        recipe = self.recipe
        if recipe.mask == profiles.LENSLET:
            rolloff = MOSAIC_ROLLOFF if colours else None
            if not recipe.white:
                return LensletDecoder(shape, workers=recipe.workers, rolloff=rolloff)
            white = self.read(recipe.white)
            with naming(recipe.white):
                return LensletDecoder.with_white(self.plane(white), workers=recipe.workers, rolloff=rolloff)
        camera = self.camera(model)
        known = self._calibration() if recipe.calibration and recipe.decided is None else None
        law = recipe.law or (camera.law if known is None else known.law)
        law = law if recipe.decided is None else recipe.decided.law
        return MaskDecoder(
            MaskedOptics(camera.sensor(shape), profiles.mask(recipe.mask).mask, law, camera.mask_distance_mm),
            calibration=known,
            ratio=None if recipe.decided is None else recipe.decided.ratio,
            workers=recipe.workers,
            colours=colours,
            taper=recipe.taper,
        )

    def _narrowest_f(self, raw: RawFile) -> float | None:
        """The narrowest stop of the camera's lens, where its profile knows it."""
        stops = self.camera(raw.model or "").f_numbers
        return None if stops is None else stops[1]

    @cached_property
    def _ranging(self) -> dict[str, Any]:
        """The attribute that leads from disparity to metres, where the calibration was made with targets too."""
        tables = calibration_files.tables(Path(self.recipe.calibration)) if self.recipe.calibration else {}
        return {RANGING: tables[RANGING]} if RANGING in tables else {}

    def _calibration(self) -> Calibration:
        return calibration_files.load(Path(self.recipe.calibration))


def doubts_of(decoder: Decoder) -> tuple[Finding, ...]:
    """What is doubtful about a decoder's calibration: no law explains it, or its frames were not linear."""
    known = decoder.calibration if isinstance(decoder, MaskDecoder) else None
    return () if known is None else known.doubts


def known_to(decoder: MaskDecoder, focal_sigma_mm: float | None) -> MaskDecoder:
    """Return the decoder for a focal length with this standard error; None keeps the decoder's own."""
    return decoder if focal_sigma_mm is None else replace(decoder, focal_sigma_mm=focal_sigma_mm)


@contextmanager
def _timed(ms: dict[str, float], what: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    ms[what] = (time.perf_counter() - began) * 1e3


class FrameLineariser:
    """Makes frames of one recipe linear. Keeps what every frame needs: dark and white frame, defects, gains; `doubts`
    are those about the white frame."""

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        self.doubts: list[Finding] = []
        self._dark: NDArray[Any] | None = None
        self._defects: Places | None = None
        self._gains: dict[tuple[int, int], Plane] = {}
        self._balance: NDArray[np.float64] | None = None
        self._staggered: dict[tuple[tuple[int, int], str], bool] = {}

    def plane(self, raw: RawFile) -> Plane:
        """Return a frame's linear plane: black, white and dark frame; for masks also even colours and white frame."""
        source = self.upright(self.rows(raw, colour=False)[0], raw)
        return source.plane(self._recipe.workers) if isinstance(source, LinearRows) else source

    def upright(self, rows: LinearRows, raw: RawFile) -> Source:
        """Put each sample where it is on the chip: spread the samples of a staggered sensor."""
        if self._recipe.mask == profiles.LENSLET:
            return rows
        if self._is_staggered(rows.shape, raw.model or ""):
            return spread(rows.plane(self._recipe.workers))
        return rows

    def clipped(self, raw: RawFile) -> Plane | None:
        """Return 1 where a masked frame's pixel is clipped and 0 elsewhere; spread, local means stay the same. None
        where none is."""
        found = (shares_of_white(raw, 1) >= WHITE_SHARE).astype(np.float32)
        if not found.any():
            return None
        return spread(found) if self._is_staggered(raw.mosaic.shape, raw.model or "") else found

    def _is_staggered(self, shape: tuple[int, int], model: str) -> bool:
        if (shape, model) not in self._staggered:
            self._staggered[shape, model] = camera_profile(self._recipe, model).staggered(shape)
        return self._staggered[shape, model]

    def rows(self, raw: RawFile, *, colour: bool) -> tuple[LinearRows, Painter | None]:
        """Return the plane's linear rows, and with `colour` what makes their light field's views coloured."""
        raw = override(raw, self._recipe)
        lenslets = self._recipe.mask == profiles.LENSLET
        cfa, black = raw.colour_pattern()
        balance = None if cfa is None or not lenslets else self._white_balance()
        dark = self._dark_frame()
        if dark is not None and dark.shape == raw.mosaic.shape:
            period = (1, 1) if cfa is None else (cfa.shape[0], cfa.shape[1])
            if self._defects is None:
                self._defects = find_defects(dark, period)
                self._dark = dark = mended(dark, self._defects, period)
            raw = replace(raw, mosaic=mended(raw.mosaic, self._defects, period))
        check_shape(raw.mosaic)
        shape = raw.mosaic.shape[0], raw.mosaic.shape[1]
        reference: list[int] = []
        flat = self._gain(shape) if self._recipe.white and not lenslets else None
        painted: Painter | None = None
        if cfa is not None:
            names = raw.colour_names
            # Behind lenslets the grey view is the mean of the colours; a masked frame has most of its detail in green.
            reference = [names.index("G")] if "G" in names and not lenslets else sorted({int(c) for c in cfa.flat})
            if colour and all(name in names for name in "RGB"):
                even = planes.to_plane(raw.mosaic, black=black, white=raw.white, cfa=cfa, balance=balance, dark=dark)
                colours = [names.index(name) for name in "RGB"]
                if lenslets:
                    painted = _by_shares(local_colours(even, cfa, colours, reference), even.shape)
                else:
                    painted = self._by_dc_views(even if flat is None else even * flat, cfa, colours, raw)
        elif colour:
            raise DecodeError("the frame has no colour pattern: decode it without --colour, or name it with --cfa")
        linear = lineariser(shape, black=black, white=raw.white, cfa=cfa, balance=balance, reference=reference)
        return linear.apply(raw.mosaic, dark=dark, flat=flat), painted

    def _by_dc_views(self, even: Plane, cfa: NDArray[np.int64], colours: list[int], raw: RawFile) -> Painter:
        """Colours of masked frames: each from its own pixels, where they are on the chip."""
        shape = even.shape[0], even.shape[1]
        index = colour_index(shape, cfa)
        if self._is_staggered(shape, raw.model or ""):
            even, index = spread(0.5 * even), np.rint(spread(index + np.float32(1)) / 2).astype(np.int8) - np.int8(1)

        def painted(field: LightField) -> NDArray[np.float32]:
            size = field.views.shape[2], field.views.shape[3]
            made = dc_views(even, index, colours, size, field.grid)
            sensor = camera_profile(self._recipe, raw.model or "").sensor((even.shape[0], even.shape[1]))
            aspect = field.grid[0, 0] * math.hypot(*sensor.row_mm) / (field.grid[1, 1] * math.hypot(*sensor.column_mm))
            grey = field.slices[0].real
            return in_colour(field.views, grey, made, row_over_column=aspect, workers=self._recipe.workers)

        return painted

    def _white_balance(self) -> NDArray[np.float64] | None:
        """Return the gains that make the white frame grey; None without one."""
        if self._recipe.white and self._balance is None:
            raw = self._white_frame()
            cfa, black = raw.colour_pattern()
            if cfa is not None:
                self._balance = planes.estimate_balance(raw.mosaic, black=black, cfa=cfa)
        return self._balance

    def _white_frame(self) -> RawFile:
        raw, masked = read(self._recipe.white, self._recipe), self._recipe.mask != profiles.LENSLET
        self.doubts = not_linear(raw, exposure(raw), masked=masked, of=Subject("white frame"))
        return raw

    def _dark_frame(self) -> NDArray[Any] | None:
        if self._recipe.dark and self._dark is None:
            self._dark = read(self._recipe.dark, self._recipe).mosaic
        return self._dark

    def _gain(self, shape: tuple[int, int]) -> Plane:
        if shape not in self._gains:
            raw = self._white_frame()
            with naming(self._recipe.white):
                cfa, black = raw.colour_pattern()
                white = planes.to_plane(raw.mosaic, black=black, white=raw.white, cfa=cfa)
                self._gains[shape] = planes.white_gain(white, cell_px=math.sqrt(white.size) / 32)
        return self._gains[shape]


def _by_shares(shares: NDArray[np.float32], shape: tuple[int, ...]) -> Painter:
    """Colours of frames behind lenslets: local ones, the same for all views of a place."""
    return lambda field: coloured(field.views, field.grid, shares, shape)
