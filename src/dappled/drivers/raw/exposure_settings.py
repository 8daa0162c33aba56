"""What a frame's file says of its exposure, apart from what reads it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ExposureSettings:
    """Camera and exposure as recorded in the file; None where they are not.

    `taken` is local time without a zone, ISO 8601 ("2008-04-15T13:11:23" or with a fraction). `focal_sigma_mm` is half
    of what the focal length is rounded to; `temperature_c` is the body's, of Canon EOS bodies.
    """

    make: str | None = None
    model: str | None = None
    focal_length_mm: float | None = None
    f_number: float | None = None
    exposure_s: float | None = None
    iso: float | None = None
    taken: str | None = None
    focal_sigma_mm: float | None = None
    temperature_c: float | None = None
