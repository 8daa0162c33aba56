"""A calibration of the simulated camera, made as a user would make it: from its stopped-down bench frame."""

from __future__ import annotations

from pathlib import Path

import tomli_w

from dappled.config import profiles
from dappled.decode.calibration.fit import CalibrationFrame, calibrate
from dappled.decode.spectrum.plane import to_plane
from dappled.drivers.raw import reading
from dappled.mocks.scene.masked_camera import MaskedCamera

CAMERA, MASK = "reference-36mm", "reference-5x5"
"""The shipped profiles of the reference camera."""


def write(camera: MaskedCamera, folder: Path) -> Path:
    """What `dappled calibrate` makes of the bench frame of a reference camera; the file that it wrote."""
    raw = reading.read(camera.bench_frame().file, "bench frame")
    profile = profiles.camera(CAMERA)
    plane = to_plane(raw.mosaic, black=raw.black, white=raw.white, cfa=raw.cfa)
    assert raw.focal_length_mm is not None  # the simulated camera writes both into its files
    assert raw.f_number is not None
    found = calibrate(
        [CalibrationFrame(plane, raw.focal_length_mm, raw.f_number)],
        sensor=profile.sensor((plane.shape[0], plane.shape[1])),
        mask=profiles.mask(MASK).mask,
        law=profile.law,
        mask_distance_mm=profile.mask_distance_mm,
    )
    path = folder / "calibration.toml"
    path.write_text(tomli_w.dumps(found.to_dict()), encoding="utf-8")
    return path
