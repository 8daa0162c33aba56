"""Camera and mask profiles: shipped ones by name, a user's own by file, with the same validation."""

from __future__ import annotations

import re
import tomllib
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any

from dappled import codec
from dappled.config.schema import ConfigError, TomlSource, build, read_toml, setting
from dappled.decode.optics import LAWS, Mask, Sensor

_SHIPPED = Path(__file__).with_name("profiles")
LENSLET = "lenslet"  # not a profile: the lattice is found in the frame itself


@dataclass(frozen=True, slots=True)
class RawShape:
    """One raw shape that a camera delivers, and the positions of its samples on the chip.

    `staggered`: every second row, from the second on, is shifted half a column to the right.
    """

    name: str
    sensor: Sensor
    staggered: bool = False


@dataclass(frozen=True, slots=True)
class Lens:
    """The lens at one focal length, as `dappled calibrate --lens` finds it: `v_mm` from perspective centre to sensor,
    the principal point (y, x) in mm from the sensor's middle, OpenCV's distortion (k1, k2, p1, p2, k3)."""

    focal_length_mm: float = setting(MISSING, "as EXIF says it", unit="mm", low=0.1, high=10_000)
    v_mm: float = setting(MISSING, "perspective centre to sensor", unit="mm", low=0.1, high=10_000)
    principal_point_mm: tuple[float, float] = setting((0.0, 0.0), "(y, x) from the middle", unit="mm", low=-50, high=50)
    distortion: tuple[float, float, float, float, float] = setting(
        (0.0, 0.0, 0.0, 0.0, 0.0), "OpenCV's k1, k2, p1, p2, k3", low=-1000, high=1000
    )


@dataclass(frozen=True, slots=True)
class VerdictBounds:
    """Bounds by which the frames of a flight are judged: above the first of a pair a frame is only usable, above the
    second it is bad. Blur is in pixels of a view, and of the frame for the picture at the sensor's own resolution."""

    blur_usable_px: float = setting(
        0.5, "motion blur above which a frame is only usable", unit="view px", low=0, high=100
    )
    blur_bad_px: float = setting(1.0, "motion blur above which a frame is bad", unit="view px", low=0, high=100)
    defocus_usable_px: float = setting(
        0.7, "defocus above which a frame is only usable", unit="view px", low=0, high=100
    )
    defocus_bad_px: float = setting(1.3, "defocus above which a frame is bad", unit="view px", low=0, high=100)
    picture_usable_px: float = setting(
        2.0, "blur of the picture above which a frame is only usable", unit="px", low=0, high=1000
    )
    clipped_usable: float = setting(0.01, "clipped share above which a frame is only usable", low=0, high=1)
    clipped_bad: float = setting(0.05, "clipped share above which a frame is bad", low=0, high=1)
    black_usable: float = setting(0.5, "black share above which a frame is only usable", low=0, high=1)
    mean_least: float = setting(0.01, "mean share of white below which a frame is bad", low=0, high=1)
    carriers_share: float = setting(0.5, "share of the predicted carriers that a good frame shows", low=0, high=1)
    position_sigma_m: float = setting(
        10.0, "position's sigma above which a frame is only usable", unit="m", low=0, high=1e6
    )


@dataclass(frozen=True, slots=True)
class CameraProfile:
    """The properties of a body that the prediction of carriers needs. `law` is a name in
    `dappled.decode.optics.carriers.LAWS`. No mask can be mounted nearer than `least_mask_distance_mm` to the sensor;
    the lens has the stops between `f_numbers` (widest, narrowest); None where unknown."""

    name: str
    description: str
    models: tuple[str, ...]
    law: str
    mask_distance_mm: float
    focal_length_mm: tuple[float, float] | None
    raw: tuple[RawShape, ...]
    lenses: tuple[Lens, ...] = ()
    least_mask_distance_mm: float | None = None
    f_numbers: tuple[float, float] | None = None
    verdict: VerdictBounds = field(default_factory=VerdictBounds)

    def lens(self, focal_length_mm: float) -> Lens | None:
        """The lens calibrated within 2 % of a focal length; None where there is none."""
        nearest = min(self.lenses, key=lambda lens: abs(lens.focal_length_mm - focal_length_mm), default=None)
        if nearest is None or abs(nearest.focal_length_mm / focal_length_mm - 1) > 0.02:
            return None
        return nearest

    def sensor(self, shape: tuple[int, int]) -> Sensor:
        """The sensor geometry of frames of this shape, or of spread planes. Raises ConfigError for unknown shapes."""
        for known in self.raw:
            if known.sensor.shape == shape:
                return known.sensor
        for known in self.raw:
            if known.staggered and known.sensor.spread().shape == shape:
                return known.sensor.spread()
        sizes = ", ".join(f"{h} × {w}" for h, w in (known.sensor.shape for known in self.raw))
        raise ConfigError(
            f"camera profile {self.name} describes frames of {sizes} px, this one is {shape[0]} × {shape[1]}; "
            "choose another camera.profile, or add the shape to your own profile"
        )

    def shapes(self) -> set[tuple[int, int]]:
        """The shapes of its frames, and of staggered ones when they are spread."""
        spread = {known.sensor.spread().shape for known in self.raw if known.staggered}
        return {known.sensor.shape for known in self.raw} | spread

    def staggered(self, shape: tuple[int, ...]) -> bool:
        """Whether mosaics of this shape are staggered and must be spread before they are decoded."""
        return any(known.staggered and known.sensor.shape == shape for known in self.raw)


@dataclass(frozen=True, slots=True)
class MaskProfile:
    """A mask. `period_px` and `film_px_per_mm` are those of its print; None where only the frequency is known."""

    name: str
    description: str
    mask: Mask
    period_px: float | None = None
    film_px_per_mm: float | None = None


@dataclass(frozen=True, slots=True)
class _CameraTable:
    law: str = setting("fd", "carrier law", choices=tuple(LAWS))
    mask_distance_mm: float = setting(1.0, "mask to sensor", unit="mm", low=1e-3, high=100)
    raw: tuple[dict[str, Any], ...] = setting((), "raw shapes")  # each is built from a table of its own
    lens: tuple[dict[str, Any], ...] = setting((), "calibrated lenses")
    description: str = setting("", "one line")
    models: tuple[str, ...] = setting((), "model names as EXIF and libgphoto2 write them")
    focal_length_mm: tuple[float, float] | None = setting(None, "shortest and longest", unit="mm", low=0.1, high=10_000)
    least_mask_distance_mm: float | None = setting(
        None, "nearest that a mask can be mounted to the sensor: its cover glass", unit="mm", low=0, high=100
    )
    f_number: tuple[float, float] | None = setting(None, "widest and narrowest stop of the lens", low=0.5, high=256)
    verdict: dict[str, Any] | None = setting(None, "bounds for frames")  # noqa: RUF009  the default is None


@dataclass(frozen=True, slots=True)
class _RawTable:
    shape: tuple[int, int] = setting((0, 0), "rows and columns", low=1, high=100_000)
    row_mm: tuple[float, float] = setting((0.0, 0.0), "one row down, as (y, x)", unit="mm", low=-1, high=1)
    column_mm: tuple[float, float] = setting((0.0, 0.0), "one column right, as (y, x)", unit="mm", low=-1, high=1)
    name: str = setting("", "which shape this is")
    staggered: bool = setting(False, "every second row sits half a column to the right")
    picture: str = setting("", "name of the shape above on whose DFT the fd law counts bins, where not on this one's")


@dataclass(frozen=True, slots=True)
class _MaskTable:
    p: int = setting(2, "number of harmonics", low=1, high=20)
    frequency_per_mm: float | None = setting(None, "fundamental", unit="1/mm", low=0.01, high=2000)
    period_px: float | None = setting(None, "longest period on film", unit="px", low=0.1, high=100_000)
    film_px_per_mm: float | None = setting(None, "printer's pixels", unit="px/mm", low=0.1, high=10_000)
    pattern: str = setting("full", "Eq 11 or Fig 14", choices=("full", "diagonal"))
    harmonics: str = setting("linear", "1, 2, 3 … or 1, 2, 4 …", choices=("linear", "octave"))
    description: str = setting("", "one line")


def tables(name: str, kind: str) -> dict[str, Any]:
    """The tables of a profile's file; `kind` is "cameras" or "masks"."""
    return _read(name, kind)[0]


def camera(name: str) -> CameraProfile:
    """The camera profile of a shipped name or a TOML file. Raises ConfigError."""
    tables, source = _read(name, "cameras")
    table = build(_CameraTable, tables, source, "")
    if not table.raw:
        raise ConfigError(f"{source.name} has no [[raw]] table: name at least one raw shape with row_mm and column_mm")
    shapes: list[RawShape] = []
    for entry in table.raw:
        raw = build(_RawTable, entry, source, "raw")
        if not any(raw.row_mm) or not any(raw.column_mm) or not all(raw.shape):
            raise ConfigError(f"{source.name}: [[raw]] {raw.name!r} needs shape, row_mm and column_mm")
        picture = next((known.sensor for known in shapes if known.name == raw.picture), None)
        if raw.picture and picture is None:
            raise ConfigError(
                f"{source.name}: [[raw]] {raw.name!r} names the picture {raw.picture!r}, which no [[raw]] above has"
            )
        shapes.append(RawShape(raw.name, Sensor(raw.shape, raw.row_mm, raw.column_mm, picture), raw.staggered))
    return CameraProfile(
        _stem(name),
        table.description,
        table.models,
        table.law,
        table.mask_distance_mm,
        table.focal_length_mm,
        tuple(shapes),
        tuple(build(Lens, entry, source, "lens") for entry in table.lens),
        table.least_mask_distance_mm,
        table.f_number,
        build(VerdictBounds, table.verdict or {}, source, "verdict"),
    )


def mask(name: str) -> MaskProfile:
    """The mask profile of a shipped name or a TOML file. Raises ConfigError."""
    tables, source = _read(name, "masks")
    table = build(_MaskTable, tables, source, "")
    if table.frequency_per_mm is not None and (table.period_px is not None or table.film_px_per_mm is not None):
        raise ConfigError(
            f"{source.name} gives frequency_per_mm and period_px or film_px_per_mm: leave one of them out"
        )
    if table.frequency_per_mm is not None:
        frequency = table.frequency_per_mm
    elif table.period_px is not None and table.film_px_per_mm is not None:
        frequency = table.film_px_per_mm / table.period_px
    else:
        raise ConfigError(f"{source.name} needs frequency_per_mm, or period_px and film_px_per_mm")
    return MaskProfile(
        _stem(name),
        table.description,
        Mask(frequency, table.p, table.pattern, table.harmonics, table.film_px_per_mm),  # type: ignore[arg-type]  # the schema checked the choices
        table.period_px if table.film_px_per_mm is not None else None,
        table.film_px_per_mm if table.period_px is not None else None,
    )


def shipped(kind: str) -> list[str]:
    """Names of the shipped profiles; `kind` is "cameras" or "masks"."""
    return sorted(path.stem for path in (_SHIPPED / kind).glob("*.toml"))


def camera_for_model(model: str) -> CameraProfile | None:
    """The shipped profile that lists a body's model name, ignoring spaces and case; None where none does."""
    wanted = _plain(model)
    for name in shipped("cameras"):
        profile = camera(name)
        if wanted and wanted in {_plain(known) for known in profile.models}:
            return profile
    return None


def _plain(model: str) -> str:
    return re.sub(r"[^a-z0-9]", "", model.lower())


def _stem(name: str) -> str:
    return Path(name).stem if name.endswith(".toml") else name


def _read(name: str, kind: str) -> tuple[dict[str, Any], TomlSource]:
    if name.endswith(".toml"):
        return read_toml(Path(name).expanduser())
    names = shipped(kind)
    if name not in names:
        near = codec.nearest(name, names)
        hint = f"did you mean {near}?" if near else f"shipped: {', '.join(names)}"
        raise ConfigError(f"no {kind[:-1]} profile {name!r}; {hint} A profile of your own is named by its .toml file")
    text = (_SHIPPED / kind / f"{name}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text), TomlSource(f"profile {name}", text)
