"""Arguments that the actions of `mask` share: the mask, its distance from the sensor, the camera and the law."""

from __future__ import annotations

from dataclasses import dataclass

from dappled.cli.table import words_only
from dappled.cli.verb import option
from dappled.config.schema import ConfigError
from dappled.config.settings import LAW_NAMES

if not words_only:
    from dappled.config import profiles
    from dappled.config.profiles import CameraProfile
    from dappled.decode.optics import MaskedOptics, Sensor, lenses

FILM_NAMES = ("4k", "8k", "16k")


@dataclass(frozen=True, kw_only=True)
class SensorArguments:
    """--camera and --shape."""

    camera: str = option("--camera", "camera profile or TOML file")
    shape: tuple[int, int] | None = option(
        "--shape", "raw shape", None, low=1, metavar=("H", "W"), otherwise="the camera's first",
    )  # fmt: skip

    def sensor(self) -> Sensor:
        """The camera's sensor for --shape, or for its first raw shape. Raises ConfigError for a shape it hasn't."""
        camera = profiles.camera(self.camera)
        return camera.sensor(self.shape) if self.shape else camera.raw[0].sensor


@dataclass(frozen=True, kw_only=True)
class InstallationArguments(SensorArguments):
    """--law and --mask-distance."""

    law: str = option("--law", "carrier law", "", choices=LAW_NAMES, otherwise="the camera's")
    mask_distance: float | None = option(
        "--mask-distance", "distance from mask to sensor", None, unit="mm", otherwise="the camera's",
    )  # fmt: skip

    def installed(self, mask: str) -> tuple[CameraProfile, MaskedOptics]:
        """The camera, and what these arguments name with a mask. Raises ConfigError."""
        camera = profiles.camera(self.camera)
        distance = camera.mask_distance_mm if self.mask_distance is None else self.mask_distance
        return camera, MaskedOptics(self.sensor(), profiles.mask(mask).mask, self.law or camera.law, distance)


@dataclass(frozen=True, kw_only=True)
class AltitudeArguments(SensorArguments):
    """--altitude, and the camera that is flown there."""

    altitude: float = option("--altitude", "height above ground", unit="m", low=1e-3, high=1e6)
    focal_length: float | None = option(
        "--focal-length", "focal length of the lens", None, unit="mm", otherwise="the camera's, if it has only one",
    )  # fmt: skip

    def camera_set(self) -> tuple[CameraProfile, Sensor, float]:
        """The camera, its sensor, its focal length in mm. Raises ConfigError where that isn't known."""
        camera = profiles.camera(self.camera)
        length = only_length(camera) if self.focal_length is None else self.focal_length
        if length is None:
            raise ConfigError(
                f"{camera.name} does not fix the focal length: give the lens' setting in mm with --focal-length"
            )
        return camera, self.sensor(), lenses.focal_length(length)


def only_length(camera: CameraProfile) -> float | None:
    """The focal length of a lens that can't zoom; None for others."""
    known = camera.focal_length_mm
    return known[0] if known is not None and known[0] == known[1] else None


def out_of_reach(camera: CameraProfile, ideal: float) -> str | None:
    """A sentence where the lens has no stop as small as a mask's ideal f-number; None where it has or nobody knows."""
    if camera.f_numbers is None or ideal <= camera.f_numbers[1] * 1.05:
        return None
    return (
        f"the lens of {camera.name} only stops down to f/{camera.f_numbers[1]:g}: this mask separates its views at "
        f"f/{ideal:.3g}; wider open it mixes them, and few carriers can be seen (dappled mask table --visibility)"
    )
