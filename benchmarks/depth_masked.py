"""Masked frames of `depth_scenes.py`: the same scenes through a lens and a printed mask of 5 × 5 views, and decoded.

A frame is the light of all aperture points behind the mask, `POINTS` a view along each axis (a lens is continuous, five
points are not). The scene is as sharp as a view of `side` pixels, which is about what a slice holds. The camera is the
reference camera, calibrated on a stopped-down white frame; disparities are scaled so that neighbouring views differ by
as much as in the plain views of the same scene, in pixels of a view.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from depth_scenes import RAYS, Floats, Scene, seen
from numpy.typing import NDArray
from scipy import fft, ndimage

from dappled.decode.calibration.calibration import Calibration
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.decoder import MaskDecoder
from dappled.decode.lightfield.light_field import LightField
from dappled.decode.optics import Mask, MaskedOptics, Sensor
from dappled.mocks.scene import chip_faults
from dappled.mocks.scene.ray_camera import RayCamera

MASK = Mask(15.5, 2)
FOCAL_MM, DISTANCE_MM, F_NUMBER, WHITE_AT = 50.0, 0.48, 7.44, 29.76
VIEWS, POINTS = 5, 2
LEVEL = 0.35  # the mean of a frame, 1.0 = white
SENSOR_PX = 6.5  # of the sensor for one of the scene, near what a slice's sample takes
_RIM = 16  # px of the scene around the frame, mirrored
SNRS: Mapping[str, float] = {"clean": 0.0, "snr100": 100.0, "snr50": 50.0}  # of a pixel at the mean; 0: no noise


@dataclass(frozen=True, eq=False)
class MaskedFrame:
    """`plane` (H, W) without noise, and the true `disparity` (side, side) in pixels of the scene from view to view."""

    plane: Floats
    disparity: Floats

    def decoded(self, snr: float, seed: int = 0) -> tuple[LightField, Floats]:
        """The light field at a signal-to-noise ratio (0: no noise), and the true disparity on its views' pixels."""
        plane = self.plane
        if snr:
            well = snr**2 / LEVEL
            plane = chip_faults.with_noise(plane, well, 0.0, np.random.default_rng([seed, 41]))
        known = calibrated(len(plane))
        decoder = MaskDecoder(MaskedOptics(known.sensor, MASK, "geometric", DISTANCE_MM), known)
        field = decoder.decode(plane, focal_length_mm=FOCAL_MM, f_number=F_NUMBER)
        return field, self._truth_on(field)

    def _truth_on(self, field: LightField) -> Floats:
        rows, columns = field.views.shape[2:4]
        scale = len(self.plane) / len(self.disparity)
        y, x = np.mgrid[0:rows, 0:columns].astype(np.float64)
        places = (field.grid[0, 0] * y + field.grid[0, 2], field.grid[1, 1] * x + field.grid[1, 2])
        at = np.array([(place + 0.5) / scale - 0.5 for place in places])
        found = ndimage.map_coordinates(self.disparity, at, order=0, mode="nearest")
        return np.asarray(found * scale / field.grid[1, 1], dtype=np.float32)


def camera(side_px: int) -> RayCamera:
    """The reference camera with a square sensor."""
    return RayCamera(
        MASK, shape=(side_px, side_px), f_number=F_NUMBER, stop="square", views=VIEWS, full_well_e=0.0, read_noise_e=0.0
    )


@cache
def calibrated(side_px: int) -> Calibration:
    """By a white frame, stopped down."""
    white = replace(camera(side_px).calibration(WHITE_AT), level=0.2, full_well_e=28_600.0).expose().plane
    sensor = Sensor((side_px, side_px), (0.01, 0.0), (0.0, 0.01))
    shot = CalibrationFrame(white, FOCAL_MM, WHITE_AT)
    return calibrate([shot], MaskedOptics(sensor, MASK, "geometric", DISTANCE_MM))


def expose(scene: Scene, side: int, points: int = POINTS) -> MaskedFrame:
    """Take the picture of a scene, without noise."""
    sensor_px = round(side * SENSOR_PX)
    one = camera(sensor_px)
    _, strengths, per_mm = one.orders()
    steps = (np.arange(VIEWS * points) + 0.5) / points - VIEWS / 2  # in views
    turns = np.exp(
        2j * np.pi * one.alpha * np.outer(per_mm, steps * one.aperture_mm / VIEWS).reshape(*per_mm.shape, -1)
    )
    waves = np.zeros((len(per_mm) + 1, side, side), dtype=np.complex64)  # the mean, then a wave for each order
    for row, sy in enumerate(steps):
        for column, sx in enumerate(steps):
            light, _ = seen(scene, side, float(sy), float(sx))
            view = light.reshape(side, RAYS, side, RAYS).mean(axis=(1, 3))
            waves[0] += view
            weights = strengths * turns[:, 0, row] * turns[:, 1, column]
            for number, weight in enumerate(weights):
                waves[number + 1] += np.complex64(weight) * view
    waves /= len(steps) ** 2
    place = (np.arange(sensor_px) - (sensor_px - 1) / 2) * 0.01 * (1 - one.alpha)
    plane = _enlarged(waves[0].real, sensor_px)
    for wave, (fy, fx) in zip(waves[1:], per_mm, strict=True):
        carrier = np.exp(2j * np.pi * fy * place)[:, None] * np.exp(2j * np.pi * fx * place)[None, :]
        plane += 2 * (_enlarged(wave.real, sensor_px) * carrier.real - _enlarged(wave.imag, sensor_px) * carrier.imag)
    plane = _on_pixels(plane)
    _, disparity = seen(scene, side, 0.0, 0.0)
    return MaskedFrame(
        np.asarray(plane * (LEVEL / plane.mean()), dtype=np.float32),
        disparity[RAYS // 2 :: RAYS, RAYS // 2 :: RAYS].copy(),
    )


def _enlarged(image: Floats, side: int) -> NDArray[np.float64]:
    """(side, side): the same picture with nothing added beyond its pixels' limit, mirrored around."""
    count = len(image) + 2 * _RIM
    spectrum = fft.fft2(np.pad(image, _RIM, mode="symmetric"))
    scale = side / len(image)
    # Pixel i of the large picture lies at (i + 0.5)/scale − 0.5 + _RIM of the small one.
    at = (np.arange(side) + 0.5) / scale - 0.5 + _RIM
    turns = np.exp(2j * np.pi * np.outer(at, fft.fftfreq(count))) / count
    return np.asarray((turns @ spectrum @ turns.T).real)


def _on_pixels(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mean over each pixel's square."""
    box = [np.sinc(f(len(plane))) for f in (fft.fftfreq, fft.rfftfreq)]
    return np.asarray(fft.irfft2(fft.rfft2(plane) * box[0][:, None] * box[1], s=plane.shape))
