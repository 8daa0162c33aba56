"""The optics of the simulated masked camera: aperture, mask, and the rays that join them.

Axes are (y, x) in millimetres on an upright picture: y grows with the row, x with the column, zero on the optical
axis. The aperture and the mask use the same axes. A ray from aperture point θ to sensor point x
  - crosses the mask at (1 − α)·R·x + α·R·θ + shift, α = d / v (d mask to sensor, v exit pupil to sensor, R the mask's
    rotation), as in Veeraraghavan et al. 2007, and
  - left the scene at x·Z/v − θ·(1 − Z/F), at depth Z with the lens focused at F.
So a point at depth Z is seen, from aperture point θ, at X·v/Z + θ·v·(1/Z − 1/F): nearer than focus, a larger θ sees it
at a larger x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Singles
from dappled.decode.optics import LAWS, Lattice, Mask, Order, Sensor
from dappled.mocks.autopilot.path import TruePose


@dataclass(frozen=True, slots=True)
class Optics:
    """The nominal lens and mask: what a person would write in a profile.

    `focal_length_mm` is v too: the distance of the lens' exit pupil when it is focused at infinity. `aperture_mm` is
    the side of the full (square) aperture and `f_number` what the body reports for it; stopped down to N, the side is
    `aperture_mm` · `f_number` / N. The aperture is `aperture_samples`² points at the centres of as many equal cells.
    `law` (a name in `decode.carriers.LAWS`) places the carriers on the sensor; the angular frequencies are the
    geometric ones under any law.
    """

    focal_length_mm: float
    f_number: float
    aperture_mm: float
    mask: Mask
    mask_distance_mm: float
    focus_m: float = math.inf
    aperture_samples: int = 5
    law: str = "geometric"

    def used_aperture_mm(self, f_number: float) -> float:
        """Side of the aperture at this f-number. Raises ValueError where the lens does not open so far."""
        if not f_number >= self.f_number:
            raise ValueError(f"f/{f_number:g} is wider than the simulated lens opens (f/{self.f_number:g})")
        return self.aperture_mm * self.f_number / f_number

    def aperture_points_mm(self, f_number: float) -> NDArray[np.float64]:
        """(n, n, 2): the aperture points (θy, θx) at this f-number."""
        n = self.aperture_samples
        axis = (np.arange(n) - (n - 1) / 2) / n * self.used_aperture_mm(f_number)
        return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)

    def disparity_mm_per_mm(self, depth_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """dx/dθ, the shift on the sensor for each millimetre on the aperture: v·(1/Z − 1/F)."""
        return np.asarray(self.focal_length_mm * 1e-3 * (1 / depth_m - 1 / self.focus_m), dtype=np.float64)

    def depth_m(self, shift_per_view_mm: float, views: int) -> float:
        """The depth at which views `aperture_mm` / `views` apart differ by this shift on the sensor.

        Raises ValueError where no depth does.
        """
        slope = shift_per_view_mm * views / self.aperture_mm
        inverse = slope / (self.focal_length_mm * 1e-3) + 1 / self.focus_m
        if inverse <= 0:
            raise ValueError(f"no depth makes a shift of {shift_per_view_mm:g} mm per view")
        return 1 / inverse


@dataclass(frozen=True, slots=True)
class Installation:
    """How the mask is installed in this camera, which the decoder has to find out.

    `rotation_rad` turns carriers from the row axis towards the column axis (as `Lattice.rotated`), `shift_mm` (y, x)
    is in the mask's own axes, `distance_mm` from mask to sensor.
    """

    rotation_rad: float
    shift_mm: tuple[float, float]
    distance_mm: float

    @classmethod
    def drawn(cls, seed: int, optics: Optics) -> Installation:
        """Rotation within ±2°, shift within half a period, distance within ±10 %: always the same for a seed."""
        rng = np.random.default_rng([seed, 1])
        period_mm = 1 / optics.mask.frequency_per_mm
        return cls(
            rotation_rad=math.radians(rng.uniform(-2, 2)),
            shift_mm=(float(rng.uniform(-0.5, 0.5) * period_mm), float(rng.uniform(-0.5, 0.5) * period_mm)),
            distance_mm=optics.mask_distance_mm * float(rng.uniform(0.9, 1.1)),
        )

    def rotation(self) -> NDArray[np.float64]:
        """R, (2, 2): from sensor axes (y, x) to the mask's."""
        c, s = math.cos(self.rotation_rad), math.sin(self.rotation_rad)
        return np.array([[c, s], [-s, c]])


@dataclass(frozen=True, slots=True)
class Rays:
    """The rays to render: one for every aperture point and every sensor sample.

    `y_mm` (h,) and `x_mm` (w,) are the samples' places on the sensor, `aperture_mm` (J, 2) the aperture points.
    """

    y_mm: NDArray[np.float64]
    x_mm: NDArray[np.float64]
    aperture_mm: NDArray[np.float64]
    v_mm: float
    focus_m: float


@dataclass(frozen=True, slots=True)
class Rendering:
    """The result of a scene: `radiance` (J, 3, h, w) red, green, blue in the scene's own scale; `depth_m` (h, w) along
    the axis as seen from the aperture's centre, None where it is unknown."""

    radiance: Singles
    depth_m: Singles | None


class Scene(Protocol):
    """Something to photograph."""

    @property
    def mean_radiance(self) -> float:
        """The radiance that exposure is metered on."""

    @property
    def headroom(self) -> float:
        """Brightest radiance over `mean_radiance`, roughly."""

    def render(self, rays: Rays, pose: TruePose | None) -> Rendering:
        """The radiance along the rays. Raises ValueError where the scene needs a pose and there is none."""


def transmission(mask: Mask, y_periods: NDArray[np.float64], x_periods: NDArray[np.float64]) -> NDArray[np.float64]:
    """The mask's pattern at places counted in periods of its fundamental, before scaling (Eq 11 and Fig 14).

    `full`: Σ cos(2π·ky·y)·cos(2π·kx·x) over ky, kx = 0 and the harmonics; `diagonal`: Σ cos(2π·k·y)·cos(2π·k·x).
    """
    cos_y = [np.cos(2 * np.pi * m * y_periods) for m in mask.multiples]
    cos_x = [np.cos(2 * np.pi * m * x_periods) for m in mask.multiples]
    if mask.pattern == "full":
        return np.asarray((1 + sum(cos_y)) * (1 + sum(cos_x)))
    return np.asarray(sum(cy * cx for cy, cx in zip(cos_y, cos_x, strict=True)))


def pattern_range(mask: Mask) -> tuple[float, float]:
    """(lowest, highest) value of the pattern: the printed mask is scaled so that they become 0 and 1 (Fig 14)."""
    axis = np.linspace(0, 1, 256 * mask.multiples[-1], endpoint=False)
    if mask.pattern == "full":
        one = transmission(mask, axis, np.array(0.0)) / (1 + mask.p)
        low, high = float(one.min()), float(one.max())
        return min(low * low, low * high), high * high
    values = transmission(mask, axis[:, None], axis[None, :])
    return float(values.min()), float(values.max())


def modulation(mask: Mask) -> dict[Order, float]:
    """Each carrier's Fourier coefficient over that of DC, for the half of the carriers from DC upwards."""
    low, _ = pattern_range(mask)
    if mask.pattern == "full":
        return {
            (ky, kx): 1.0 if (ky, kx) == (0, 0) else (0.5 if ky else 1.0) * (0.5 if kx else 1.0) / (1 - low)
            for ky, kx in mask.half_orders()
        }
    return {order: 1.0 if order == (0, 0) else 0.25 / -low for order in mask.half_orders()}


def carrier_lattice(optics: Optics, installation: Installation, sensor: Sensor) -> Lattice:
    """Where this camera's carriers really lie, in cycles/pixel."""
    law = LAWS[optics.law]
    lattice = law(optics.mask, sensor, installation.distance_mm, optics.focal_length_mm)
    return lattice.rotated(installation.rotation_rad)


def angular_phases(
    optics: Optics, installation: Installation, orders: list[Order], points_mm: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """(K, J): exp(2πi·k·f_m·α·R·θ) for each order and each aperture point (J, 2)."""
    alpha = installation.distance_mm / optics.focal_length_mm
    k = np.array(orders, dtype=np.float64) @ installation.rotation() * (optics.mask.frequency_per_mm * alpha)
    return np.asarray(np.exp(2j * np.pi * (k @ points_mm.T)))


def peak_over_mean(
    optics: Optics,
    installation: Installation,
    points_mm: NDArray[np.float64],
    shares: NDArray[np.float64] | None = None,
) -> float:
    """The ratio of a white frame's brightest pixel to its mean: 1 where the aperture averages the mask away.

    `shares` (J,) are those of the light that come through the points (J, 2); without them, equal ones.
    """
    weights = modulation(optics.mask)
    orders = list(weights)
    through = np.full(len(points_mm), 1 / len(points_mm)) if shares is None else shares
    held = np.abs(angular_phases(optics, installation, orders, points_mm) @ through)
    return 1 + sum(2 * weights[order] * float(h) for order, h in zip(orders[1:], held[1:], strict=True))
