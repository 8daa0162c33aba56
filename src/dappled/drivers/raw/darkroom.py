"""From a raw file to a light field: profiles, raw reading and decoder put together, for daemon and commands alike."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from dappled.config import profiles
from dappled.config.profiles import CameraProfile
from dappled.decode.calibration.calibration import Calibration
from dappled.decode.decoder import Decoder, MaskDecoder
from dappled.decode.depth.ranging import RANGING
from dappled.decode.lenslets import MOSAIC_ROLLOFF, LensletDecoder
from dappled.decode.lightfield.light_field import LightField
from dappled.decode.report import DecodeReport
from dappled.decode.spectrum.colours import coloured
from dappled.decode.spectrum.plane import Plane
from dappled.drivers.raw import calibration_files, reading
from dappled.drivers.raw.lineariser import FrameLineariser
from dappled.drivers.raw.reading import RawFile
from dappled.drivers.raw.recipe import DarkroomError, Recipe, camera_name, camera_profile, naming, read

__all__ = ["Darkroom", "DarkroomError", "DecodeResult", "Recipe", "camera_name", "known_to"]


@dataclass(frozen=True, slots=True)
class DecodeResult:
    """A decoded frame, what was decided on the way, and what took how many milliseconds."""

    light_field: LightField
    report: DecodeReport
    raw: RawFile
    ms: dict[str, float] = field(default_factory=dict)

    @property
    def carriers_found(self) -> int:
        """Carriers seen in the whole plane, the mean left out: those of the half plane and their conjugates."""
        return 2 * (self.report.found - 1)

    @property
    def carriers_predicted(self) -> int:
        """Carriers predicted on the sensor, counted likewise."""
        return 2 * (len(self.report.predicted) - 1)


class Darkroom:
    """Decodes frames by one recipe. Decoders are made once for each raw shape and camera, and kept."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self._decoders: dict[tuple[tuple[int, int], str, bool], Decoder] = {}
        self._lineariser = FrameLineariser(recipe)

    def check(self) -> None:
        """Raises DappledError when the recipe names something that isn't there or isn't right."""
        if self.recipe.camera != "auto":
            profiles.camera(self.recipe.camera)
        if self.recipe.mask != profiles.LENSLET:
            profiles.mask(self.recipe.mask)
        if self.recipe.calibration and self.recipe.mask != profiles.LENSLET:
            self._calibration()
        if self.recipe.taper and self.recipe.mask == profiles.LENSLET:
            raise DarkroomError("a taper is for the bands of a printed mask; lenslets' bands tile the spectrum whole")
        if not 0 <= self.recipe.taper <= 1:
            raise DarkroomError(f"the taper is {self.recipe.taper:g}: it must be a share of the band, from 0 to 1")
        for path in (self.recipe.white, self.recipe.dark):
            if path:
                reading.read_metadata(Path(path))

    def develop(
        self,
        path: Path | str,
        *,
        focal_length_mm: float | None = None,
        f_number: float | None = None,
        views: bool = True,
    ) -> DecodeResult:
        """Decode a frame; what is not given is taken from its file. Without `views` only the slices are made.

        Raises DappledError with the file's name and what is wrong.
        """
        ms: dict[str, float] = {}
        with _timed(ms, "read"):
            raw = self.read(path)
        with naming(path):
            with _timed(ms, "plane"):
                exposure, chroma = self._lineariser.expose(raw, colour=self.recipe.colour and views)
                plane = self._lineariser.where_taken(exposure, raw)
            decoder = self.decoder(plane.shape, raw.camera_model or "", colours=raw.cfa is not None)
            if isinstance(decoder, MaskDecoder):
                decoder = known_to(decoder, None if focal_length_mm else raw.focal_sigma_mm)
            focal_length_mm = focal_length_mm or raw.focal_length_mm
            f_number = f_number or raw.f_number
            with _timed(ms, "slices and views" if views else "slices"):
                light_field, report = decoder.decode_reported(
                    plane, focal_length_mm=focal_length_mm, f_number=f_number, views=views
                )
                if chroma is not None:
                    light_field = replace(
                        light_field, views=coloured(light_field.views, light_field.grid, chroma, plane.shape)
                    )
        attributes = {
            **light_field.attributes,
            "camera": self.camera_name(raw.camera_model),
            "mask": self.recipe.mask,
            "decoded_from": "grey" if raw.cfa is None else "mosaic",
            **(self._ranging() if views else {}),
        }
        return DecodeResult(replace(light_field, attributes=attributes), report, raw, ms)

    def plane(self, raw: RawFile) -> Plane:
        """The linear plane of a frame: black, white, dark frame; for masks also colours evened out, and white frame."""
        return self._lineariser.plane(raw)

    def read(self, path: Path | str) -> RawFile:
        """A frame's file, with what the recipe says about it. Raises DappledError."""
        return read(path, self.recipe)

    def decoder(self, shape: tuple[int, ...], model: str, *, colours: bool = False) -> Decoder:
        """The decoder for frames of this shape from this camera; `colours` where they are colour mosaics."""
        key = (shape[0], shape[1]), model, colours
        if key not in self._decoders:
            self._decoders[key] = self._make(*key)
        return self._decoders[key]

    def mask_decoder(self, shape: tuple[int, int], model: str) -> MaskDecoder:
        """The decoder of a camera with a printed mask. Raises DarkroomError for lenslets."""
        decoder = self.decoder(shape, model)
        if not isinstance(decoder, MaskDecoder):
            raise DarkroomError("lenslets have no mask to predict carriers of")
        return decoder

    def naming(self, path: Path | str) -> AbstractContextManager[None]:
        """Around mathematics on a frame: its errors get the file's name."""
        return naming(path)

    def camera(self, model: str) -> CameraProfile:
        """The camera's profile: the recipe's, or by model. Raises DappledError."""
        return camera_profile(self.recipe, model)

    def camera_name(self, model: str | None) -> str:
        """The profile's name, or the model, or "unknown": what tags and headers call the camera."""
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
        known = self._calibration() if recipe.calibration else None
        return MaskDecoder(
            camera.sensor(shape),
            profiles.mask(recipe.mask).mask,
            recipe.law or (camera.law if known is None else known.law),
            camera.mask_distance_mm,
            calibration=known,
            workers=recipe.workers,
            colours=colours,
            taper=recipe.taper,
        )

    def _ranging(self) -> dict[str, Any]:
        """What leads from disparity to metres, where the calibration was made with targets too."""
        told = calibration_files.tables(Path(self.recipe.calibration)) if self.recipe.calibration else {}
        return {RANGING: told[RANGING]} if RANGING in told else {}

    def _calibration(self) -> Calibration:
        return calibration_files.load(Path(self.recipe.calibration))


def known_to(decoder: MaskDecoder, focal_sigma_mm: float | None) -> MaskDecoder:
    """The same decoder for a frame whose focal length is known to this; None: as the decoder has it."""
    return decoder if focal_sigma_mm is None else replace(decoder, focal_sigma_mm=focal_sigma_mm)


@contextmanager
def _timed(ms: dict[str, float], what: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    ms[what] = (time.perf_counter() - began) * 1e3
