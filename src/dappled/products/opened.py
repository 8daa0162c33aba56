"""`dappled.open`: open a light field, a raw frame or a flight from Python. `docs/api.md` says what is promised.

with_views = dappled.open("frame.zarr", kind="light field")  # or a folder of n × n pictures
sharp = with_views.refocus(alpha=1.02)                # float32 (h, w) or (h, w, 3)
depth = with_views.depth(method="combined")           # .disparity, .sigma, .confidence
frame = dappled.open("frame.cr2", mask="mask-2", calibration="calibration.toml")
for frame in dappled.open("~/flights/20261121T101503Z-0a1b2c3d"): frame.views
"""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, overload

import numpy as np
from numpy.typing import NDArray

from dappled import codec
from dappled.config import profiles
from dappled.decode import DecodeError
from dappled.decode.depth import RANGING, DepthMap, DistanceMap, Ranging
from dappled.decode.depth import estimate as depths
from dappled.decode.depth import evidence as evidences
from dappled.decode.depth.evidence import Evidence
from dappled.decode.lightfield import LightField, ViewStack
from dappled.decode.lightfield import refocus as refocusing
from dappled.decode.lightfield.refocus import FocalPlane, StereoPair, eyes
from dappled.decode.optics import Sensor
from dappled.drivers.raw import developing
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.picture_maker import PictureMaker
from dappled.drivers.raw.recipe import Recipe, of_flight
from dappled.errors import DappledError, counted
from dappled.findings import FRAME, Finding, told
from dappled.flight import Tag, flight_report, layout
from dappled.products import figures, summaries
from dappled.products.exports import light_files, view_folders
from dappled.workers import one_blas_thread

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_LIGHT_FIELDS = (".zarr", ".npz", ".h5")
_SHOWN = 10  # frames of a flight, or doubts of a light field, in a notebook


class OpenError(DappledError):
    """A path can't be opened, or lacks what was requested of it; one sentence."""


class NoFrameError(OpenError, IndexError, KeyError):
    """A flight has no frame of this image index."""

    __str__ = Exception.__str__  # KeyError's own would put the sentence in quotes


class Refocusable(ABC):
    """What a light field can be asked for, and a raw frame too: it is decoded for it."""

    @abstractmethod
    def _decoded(self) -> OpenedLightField: ...

    @property
    def views(self) -> NDArray[np.float32]:
        """float32 (V, U, h, w) or (V, U, h, w, 3), linear, 1.0 = sensor white."""
        return self._decoded().field.views

    def refocus(
        self,
        *,
        alpha: float | None = None,
        disparity: float | None = None,
        distance_m: float | None = None,
        aperture: float | None = None,
        tilt: tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.float32]:
        """Return the picture focused at one α (Eq 28), disparity or distance; without one, as it was taken.

        `aperture` is the diameter of a round synthetic aperture as a share of the whole; `tilt` the change of
        disparity over the picture's height and width. float32 (h, w) or (h, w, 3), NaN where no view sees.
        """
        one = self._decoded()
        at = one.disparity_of(alpha=alpha, disparity=disparity, distance_m=distance_m)
        weights = None if aperture is None else refocusing.disc(one.stack, aperture)
        return refocusing.tilted(one.stack, FocalPlane(at, *tilt), weights=weights, workers=one.workers)

    @one_blas_thread()
    def depth(
        self, method: str = "combined", *, between: tuple[float, float] | None = None, window: int | None = None
    ) -> DepthMap:
        """Return disparities with standard errors and confidence, NaN where unknown; `method` is one of `METHODS`."""
        one = self._decoded()
        return depths.estimate(one.evidence, method, between=between, window=window, workers=one.workers)

    def plot(
        self,
        what: Literal["views", "slices", "spectrum", "depth"] = "views",
        *,
        depth: DepthMap | None = None,
        axes: Axes | None = None,
    ) -> Axes:
        """Draw the views, slices, spectrum or depth with matplotlib, into `axes` or a new figure; returns the axes.

        The spectrum is the frame's where there is one, else that of the slices' bands. `depth` is the map to draw, by
        default `self.depth()`; in metres where they are known. Raises DappledError for another word, for what the light
        field lacks, and without matplotlib.
        """
        drawings = {"views": figures.views, "slices": figures.slices, "spectrum": self._draw_spectrum}
        if what != "depth" and what not in drawings:
            raise OpenError(f"{what!r} can't be drawn: choose views, slices, spectrum or depth")
        if depth is not None and what != "depth":
            raise OpenError(f"a depth map is no part of a picture of {what}: ask for plot('depth'), or leave depth out")
        one = self._decoded()
        if what == "depth":
            made = self.depth() if depth is None else depth
            if made.disparity.shape != one.views.shape[2:4]:
                mine, theirs = one.views.shape[2:4], made.disparity.shape
                raise OpenError(f"the depth map is {theirs}, the views are {mine}: draw it with its own light field")
            if one.ranging is None:
                return figures.depth(made.disparity, "disparity, px/view", made.method, axes)
            return figures.depth(one.distances(made).distance_m, "distance, m", made.method, axes)
        return drawings[what](one.field, axes)

    def _draw_spectrum(self, field: LightField, axes: Axes | None) -> Axes:
        return figures.bands(field, axes)


@dataclass(frozen=True, repr=False)
class OpenedLightField(Refocusable):
    """A decoded light field. `field` is the plain value, `path` the file or folder that it was read from.

    `focus_m` is the distance at which the lens was focused (inf: infinity), for metres without a calibration.
    """

    field: LightField
    path: Path | None = None
    focus_m: float | None = None
    workers: int = 2

    def _decoded(self) -> OpenedLightField:
        return self

    def __repr__(self) -> str:
        """One line: where it is from, how large it is, and what took it."""
        views, slices, said = self.field.views.shape, self.field.slices.shape[0], self.field.attributes
        size = f"{views[0]} × {views[1]} views of {views[2]} × {views[3]} px" if views[0] else "no views"
        stop = said.get("f_number"), said.get("focal_length_mm")
        taken = [said.get("camera"), said.get("mask"), stop[1] and f"{stop[1]:g} mm", stop[0] and f"f/{stop[0]:g}"]
        words = [f"{size}, {slices} slices", *(str(one) for one in taken if one)]
        words += [counted(len(self.doubts), "doubt")] if self.doubts else []
        return f"<light field {'' if self.path is None else self.path.name + ': '}{', '.join(words)}>"

    def _repr_html_(self) -> str:
        """For notebooks: the line, the middle view (without views, the mean), and the doubts."""
        picture: NDArray[np.float32] | None = np.abs(self.slices[0]) if len(self.slices) else None
        with contextlib.suppress(DecodeError):
            picture = self.stack.middle()
        doubts = [f"doubt: {told(one, FRAME)}" for one in self.doubts]
        more = [f"and {len(doubts) - _SHOWN} more"] if len(doubts) > _SHOWN else []
        shown = None if picture is None or not picture.size else figures.bright(picture)
        return summaries.block(repr(self), shown, [*doubts[:_SHOWN], *more])

    @property
    def slices(self) -> NDArray[np.complex64]:
        """complex64 (K, h, w), DC first; (0, h, w) where the light field came as views."""
        return self.field.slices

    @property
    def carriers(self) -> NDArray[np.float64]:
        """float64 (K, 4): a row [ky, kx, fy, fx] for each slice, the orders and cycles/pixel."""
        return self.field.carriers

    @property
    def attributes(self) -> Mapping[str, Any]:
        """Frame shape, camera, mask, law, focal length, f-number …"""
        return self.field.attributes

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """What is in doubt about the light field."""
        return self.field.doubts

    @cached_property
    def stack(self) -> ViewStack:
        """The views with their places in the aperture. Raises DecodeError where there are none."""
        return ViewStack.of(self.field)

    @cached_property
    def evidence(self) -> Evidence:
        """What depth is estimated from. Raises DecodeError where there are fewer than 2 views."""
        return evidences.of_light_field(self.field)

    @cached_property
    def ranging(self) -> Ranging | None:
        """The conversion from disparity to metres, by a calibration with targets or by `focus_m`.

        None where depth is only relative, also where the calibration is for another focal length; `metres` says why.
        """
        with contextlib.suppress(DecodeError):
            kept = self._kept_ranging()
            if kept is not None:
                return kept
        return None if self.focus_m is None else lens_ranging(self.field, self.focus_m)

    def _kept_ranging(self) -> Ranging | None:
        """Return that of the attributes. Raises DecodeError where it is for another focal length or f-number."""
        kept = self.attributes.get(RANGING)
        if not kept:
            return None
        return Ranging.from_dict(kept).at(self.attributes.get("f_number"), self.attributes.get("focal_length_mm"))

    def disparity_of(
        self, *, alpha: float | None = None, disparity: float | None = None, distance_m: float | None = None
    ) -> float:
        """Return the disparity that one of the three arguments names; 0 for none.

        α is Eq 28's: the film's distance from the lens as a share of the sensor's, above 1 for what is nearer.
        Raises DappledError for more than one, for metres without a calibration, and for α of an unknown lens.
        """
        given = [value for value in (alpha, disparity, distance_m) if value is not None]
        if len(given) > 1:
            raise OpenError("give one of alpha, disparity and distance, not several")
        if alpha is not None:
            return refocusing.disparity_of_alpha(alpha, self._aperture_px(), self.stack)
        if distance_m is not None:
            return self.metres().disparity(distance_m, self.stack)
        return 0.0 if disparity is None else disparity

    def _aperture_px(self) -> float:
        """Return the lens' aperture in columns of the sensor. Raises OpenError where the lens is unknown."""
        found = aperture_px(self.field.attributes)
        if found is None:
            raise OpenError(
                f"{self.path or 'the light field'} doesn't say how wide its lens is (focal length, f-number, a camera "
                "with a profile), and α needs that: give the disparity in pixels from view to view (--disparity)"
            )
        return found

    def metres(self) -> Ranging:
        """Return `ranging`. Raises DappledError with what to do where it is None."""
        if self.ranging is None:
            self._kept_ranging()
            raise OpenError(
                f"{self.path or 'the light field'} has no distances: calibrate with targets "
                "(dappled calibrate --target METRES), or say where the lens was focused (--focus METRES, or inf)"
            )
        return self.ranging

    def distances(self, depth: DepthMap) -> DistanceMap:
        """Return a depth map in metres with standard errors. Raises DappledError as `metres`."""
        return self.metres().distances(depth, self.stack)

    def eyes(self, *, separation: float = 0.6, disparity: float = 0.0) -> StereoPair:
        """Return a virtual stereo pair that converges on a disparity."""
        return eyes(self.stack, separation=separation, disparity=disparity, workers=self.workers)

    def save(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write it as .zarr, .npz or .h5."""
        light_files.save(Path(path), self.field, overwrite=overwrite)


@dataclass(frozen=True, slots=True, eq=False)
class SharpPicture:
    """A frame at the sensor's own resolution, the mask's shadow divided out.

    `pixels` float32 (H, W), or (H, W, 3) in linear sRGB, 1.0 = white. `sigma` float32 (H, W) is the standard error of
    the sensor's samples as a share of white, NaN where they are not trusted; `findings` are what was found, notes too.
    """

    pixels: NDArray[np.float32]
    sigma: NDArray[np.float32]
    findings: tuple[Finding, ...]


@dataclass(frozen=True, repr=False)
class OpenedFrame(Refocusable):
    """A raw frame, decoded once, by `light_field`. `tag` says when and where it was taken; None outside a flight.

    `focal_length_mm` and `f_number` are for a frame without a tag whose file doesn't say them, or says them wrong.
    """

    path: Path
    darkroom: Darkroom
    tag: Tag | None = None
    index: int | None = None
    focus_m: float | None = None
    focal_length_mm: float | None = None
    f_number: float | None = None

    @cached_property
    @one_blas_thread()
    def light_field(self) -> OpenedLightField:
        """The decoded frame. Raises DappledError."""
        length, stop = self._optics
        made = self.darkroom.decode(self.path, focal_length_mm=length, f_number=stop)
        return OpenedLightField(made.light_field, self.path, self.focus_m)

    @one_blas_thread()
    def picture(self, *, colour: bool = True) -> SharpPicture:
        """Return the frame's picture with every pixel of the sensor; no light field is decoded for it. A frame of a
        grey sensor has no `colour`. Raises DappledError, also behind lenslets."""
        maker = PictureMaker(self.darkroom.recipe)
        maker.check()
        length, stop = self._optics
        made = maker.picture(self.path, focal_length_mm=length, f_number=stop)
        sigma = np.where(made.picture.trusted, made.picture.sigma, np.float32(np.nan))
        return SharpPicture(developing.linear(made, colour=colour), sigma, made.findings)

    @property
    def _optics(self) -> tuple[float | None, float | None]:
        """Focal length and f-number as told, or as the tag has them; None: as the file has."""
        known = self if self.tag is None else self.tag
        return known.focal_length_mm, known.f_number

    def _decoded(self) -> OpenedLightField:
        return self.light_field

    def __repr__(self) -> str:
        """One line: which frame, and what its tag says."""
        number = "" if self.index is None else f"{self.index}, "
        return f"<frame {number}{', '.join([self.path.name, Path(self.darkroom.recipe.mask).stem, *_lens(self.tag)])}>"

    def _repr_html_(self) -> str:
        """For notebooks: the line, and the light field once the frame is decoded; showing a frame decodes nothing."""
        made = self.__dict__.get("light_field")
        return summaries.block(repr(self), None) + ("" if made is None else made._repr_html_())

    def _draw_spectrum(self, field: LightField, axes: Axes | None) -> Axes:
        plane = self.darkroom.plane(self.darkroom.read(self.path))
        return figures.spectrum(plane, field, axes)


@dataclass(frozen=True, repr=False)
class OpenedFlight:
    """A recorded flight: the sequence of its safe frames, each decoded by the flight's recipe when it is used."""

    path: Path
    record: flight_report.FlightContents
    darkroom: Darkroom | None
    focus_m: float | None = None

    def __repr__(self) -> str:
        """One line: which flight, how many safe frames."""
        mask = "no mask" if self.darkroom is None else Path(self.darkroom.recipe.mask).stem
        return f"<flight {self.path.name}: {counted(len(self), 'safe frame')}, {mask}>"

    def _repr_html_(self) -> str:
        """For notebooks: the line, and a table of the first frames."""
        safe = [(line.frame, line.tag) for line in self.record.lines if line.frame is not None]
        rows = [(str(frame.index), frame.name, ", ".join(_lens(tag))) for frame, tag in safe[:_SHOWN]]
        more = [("…", f"{len(safe) - _SHOWN} more", "")] if len(safe) > _SHOWN else []
        return summaries.table(repr(self), ("index", "file", "lens"), [*rows, *more])

    def __len__(self) -> int:
        return sum(line.frame is not None for line in self.record.lines)

    def __iter__(self) -> Iterator[OpenedFrame]:
        return (self._frame(line) for line in self.record.lines if line.frame is not None)

    def __getitem__(self, index: int) -> OpenedFrame:
        """Return the frame of an image index. Raises NoFrameError, which is an IndexError and a KeyError."""
        for line in self.record.lines:
            if line.frame is not None and line.frame.index == index:
                return self._frame(line)
        raise NoFrameError(f"{self.path} has no safe frame of image index {index}; iterate over it to see which it has")

    def _frame(self, line: flight_report.ShotLine) -> OpenedFrame:
        if self.darkroom is None:
            raise OpenError(f"{self.path} was recorded without a mask: name one, as in dappled.open(path, mask=…)")
        assert line.frame is not None
        return OpenedFrame(
            layout.FlightFolder(self.path).file(line.frame.name),
            self.darkroom,
            line.tag,
            line.frame.index,
            self.focus_m,
        )


Opened = OpenedLightField | OpenedFrame | OpenedFlight
_KINDS: Mapping[str, type[Opened]] = {
    "light field": OpenedLightField, "frame": OpenedFrame, "flight": OpenedFlight,
}  # fmt: skip


@overload
def open(
    path: str | Path, *, kind: Literal["light field"], focus_m: float | None = None, **recipe: Any
) -> OpenedLightField: ...


@overload
def open(path: str | Path, *, kind: Literal["frame"], focus_m: float | None = None, **recipe: Any) -> OpenedFrame: ...


@overload
def open(path: str | Path, *, kind: Literal["flight"], focus_m: float | None = None, **recipe: Any) -> OpenedFlight: ...


@overload
def open(path: str | Path, *, kind: None = None, focus_m: float | None = None, **recipe: Any) -> Opened: ...


def open(path: str | Path, *, kind: str | None = None, focus_m: float | None = None, **recipe: Any) -> Opened:
    """Open a light field (.zarr, .npz, .h5, or a folder of n × n pictures), a flight, or a raw frame.

    `kind` says which of them is expected, so that the result has one type: "light field", "frame" or "flight".
    `focus_m` is the distance at which the lens was focused (inf: infinity). `recipe` says how frames are decoded:
    `camera`, `mask`, `law`, `calibration`, `white`, `dark`, `colour` … as in `Recipe`; in a flight these replace values
    of its own recipe. A frame whose file doesn't say them needs `focal_length_mm` and `f_number`. Raises DappledError,
    also where the path is of another kind, and for a recipe with a light field, which is decoded already.
    """
    if kind is not None and kind not in _KINDS:
        raise OpenError(f"there is no kind {kind!r}: choose {', '.join(_KINDS)}, or leave it out")
    made = _open(path, focus_m, recipe)
    if kind is not None and not isinstance(made, _KINDS[kind]):
        actual = next(word for word, one in _KINDS.items() if isinstance(made, one))
        raise OpenError(f"{path} is a {actual}, not a {kind}: open it with kind={actual!r}, or name another path")
    return made


def _open(path: str | Path, focus_m: float | None, recipe: Mapping[str, Any]) -> Opened:
    found = Path(path).expanduser()
    if not found.exists():
        raise OpenError(f"{found} does not exist; check the path")
    if found.suffix in _LIGHT_FIELDS:
        _refuse(recipe, found)
        return OpenedLightField(light_files.load(found), found, focus_m)
    if not found.is_dir():
        if wrong := not_opened(found):
            raise OpenError(wrong)
        given = dict(recipe)
        length, stop = given.pop("focal_length_mm", None), given.pop("f_number", None)
        darkroom = Darkroom(_recipe(Recipe("auto", "", workers=2), given, found))
        return OpenedFrame(found, darkroom, focus_m=focus_m, focal_length_mm=length, f_number=stop)
    if layout.FlightFolder(found).ledger.exists():
        record = flight_report.show(found)
        own = of_flight(found, record.settings, recipe)
        return OpenedFlight(found, record, None if own is None else Darkroom(own), focus_m)
    _refuse(recipe, found)
    return OpenedLightField(view_folders.read(found), found, focus_m)


_TEXTS = (".toml", ".json", ".txt", ".csv", ".md", ".py", ".sqlite", ".tlog", ".ulg")  # given by mistake


def not_opened(path: Path) -> str:
    """Why a file or folder that is there can't be opened, by its name and what it holds; "" where it may be."""
    if path.is_dir() and path.suffix not in _LIGHT_FIELDS and not layout.FlightFolder(path).ledger.exists():
        return view_folders.not_square(path)
    if path.is_file() and path.suffix.lower() in _TEXTS:
        return f"{path} is no frame: open takes a raw frame, a decoded light field or a flight"
    return ""


def light_field(path: str | Path, *, focus_m: float | None = None) -> OpenedLightField:
    """Open a light field only. Raises DappledError."""
    here = Path(path).expanduser()
    if here.exists() and (wrong := not_a_light_field(here)):
        raise OpenError(wrong)
    return open(here, kind="light field", focus_m=focus_m)


def not_a_light_field(path: Path) -> str:
    """Why a file or folder that is there can't be a light field, by its name and what it holds; "" where it may be."""
    if path.suffix in _LIGHT_FIELDS:
        return ""
    if path.is_dir() and not layout.FlightFolder(path).ledger.exists():
        return view_folders.not_square(path)
    return f"{path} is not a light field: decode it first (dappled decode), or name a .zarr, .npz or .h5"


def lens_ranging(field: LightField, focus_m: float) -> Ranging | None:
    """Return distances by Eq 5, from a light field's focal length, f-number and camera; None without one of them."""
    known = field.attributes
    sensor = _sensor(known)
    if sensor is None or not (known.get("focal_length_mm") and known.get("f_number")):
        return None
    pixel_mm = math.hypot(*sensor.column_mm)
    return Ranging.of_lens(float(known["focal_length_mm"]), float(known["f_number"]), pixel_mm, focus_m)


def aperture_px(known: Mapping[str, Any]) -> float | None:
    """Return the aperture f/N in columns of the sensor, from a light field's attributes; None where one is unknown."""
    sensor = _sensor(known)
    return None if sensor is None else sensor.aperture_px(known.get("focal_length_mm"), known.get("f_number"))


def _sensor(known: Mapping[str, Any]) -> Sensor | None:
    """Return the sensor that took a frame; None under lenslets, and where no profile has the camera."""
    if not (known.get("camera") and known.get("shape")) or known.get("lenslet_pitch_px"):
        return None
    try:
        rows, columns = known["shape"]
        return profiles.camera(str(known["camera"])).sensor((int(rows), int(columns)))
    except DappledError:
        return None


def with_ranging(field: LightField, ranging: Ranging) -> LightField:
    """Return the light field with `ranging` among its attributes."""
    return replace(field, attributes={**field.attributes, RANGING: codec.plain(ranging)})


def _lens(tag: Tag | None) -> list[str]:
    """Focal length and f-number in words, as far as they are known."""
    length, stop = (None, None) if tag is None else (tag.focal_length_mm, tag.f_number)
    words = None if length is None else f"{length:g} mm", None if stop is None else f"f/{stop:g}"
    return [one for one in words if one is not None]


def _refuse(recipe: Mapping[str, Any], path: Path) -> None:
    if recipe:
        raise OpenError(f"{path} is decoded already: leave {', '.join(recipe)} out")


def _recipe(plain: Recipe, given: Mapping[str, Any], path: Path) -> Recipe:
    try:
        made = replace(plain, **given)
    except TypeError as error:
        raise OpenError(f"{path} can't be opened with these arguments: {error}") from None
    if not made.mask:
        raise OpenError(f"{path} is a raw frame: say how to decode it, as in dappled.open(path, mask='mask-2')")
    return made
