"""Simulate the masked camera: chip, exposure, the raw file of a shot, and the truth about it.

The daemon sees only the file. The truth (views, depth, pose, installation of the mask, time of the exposure) is for
tests and pictures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Singles
from dappled.decode.optics import Lattice, Mask, Sensor
from dappled.mocks.autopilot.path import FlightPath, TruePose
from dappled.mocks.scene import dng, lens, synthesis
from dappled.mocks.scene.bench import RealViews, WhiteCard, boards
from dappled.mocks.scene.flyover import TerrainScene, finest_period_m
from dappled.mocks.scene.lens import Installation, Optics, Rays, Rendering, Scene
from dappled.mocks.scene.synthesis import PASS, Grid

MAKE, MODEL = "dappled", "Simulated Masked Camera"
ISO = 100
EXPOSURE_S = 1 / 1000  # metered, in ordinary light at full aperture
LEVEL = 0.4  # of white, where a scene's mean is metered
BRIGHTEST = 0.92  # of white, where the brightest pixel is kept
LATENCY_S, LATENCY_SPREAD_S = 0.060, 0.015


@dataclass(frozen=True, slots=True)
class SimulatedExposure:
    """One shot's outcome. `latency_s` is from the trigger to the opening of the shutter."""

    file: bytes
    mid_exposure_t_s: float
    latency_s: float
    raw: NDArray[np.uint16]
    _truth: Callable[[], Truth] = field(repr=False)
    name_suffix: str = ".dng"

    @property
    def truth(self) -> Truth:
        """The truth, computed at each call (the file is ready long before)."""
        return self._truth()


@dataclass(frozen=True, slots=True)
class MaskedCamera:
    """A camera body with a mask inside, before a scene. Everything drawn at random comes from `seed`.

    `path` says where the vehicle is, None on a bench. `installation` is drawn from the seed unless it is given.
    `epoch_utc_s` is what the body's own clock shows at the simulation's start.
    """

    seed: int
    scene: Scene
    optics: Optics
    sensor: SensorModel
    path: FlightPath | None = None
    installation: Installation | None = None
    epoch_utc_s: float = 1_781_517_600.0

    @property
    def installed(self) -> Installation:
        """How the mask is installed."""
        return self.installation or Installation.drawn(self.seed, self.optics)

    @property
    def lattice(self) -> Lattice:
        """Where the carriers really are, in cycles/pixel."""
        return lens.carrier_lattice(self.optics, self.installed, self.sensor.chip)

    def latency_s(self, shot_number: int) -> float:
        """From trigger to the opening of the shutter: within 60 ± 15 ms, its own for each shot."""
        rng = np.random.default_rng([self.seed, 2, shot_number])
        return float(LATENCY_S + LATENCY_SPREAD_S * rng.uniform(-1, 1))

    def metered(self, f_number: float) -> tuple[float, float]:
        """(exposure time in s, where it puts the scene's mean as a share of white) at an f-number.

        Stopped down, a mask is no longer averaged over the aperture and its clear spots are far brighter than the mean:
        the mean is then held lower, so that they stay below white.
        """
        points = self.optics.aperture_points_mm(f_number).reshape(-1, 2)
        peak = lens.peak_over_mean(self.optics, self.installed, points)
        level = min(LEVEL, BRIGHTEST / (peak * self.scene.headroom))
        return EXPOSURE_S * (f_number / self.optics.f_number) ** 2 * level / LEVEL, level

    def expose(
        self,
        trigger_t_s: float,
        shot_number: int,
        *,
        f_number: float | None = None,
        exposure_s: float | None = None,
    ) -> SimulatedExposure:
        """Take a picture: triggered at `trigger_t_s` (seconds on the path's clock).

        Without `f_number` the lens is open, without `exposure_s` the exposure is metered. Raises ValueError for an
        aperture that the lens doesn't have, an exposure that is not positive, and what the scene can't show.
        """
        n_stop = self.optics.f_number if f_number is None else f_number
        points = self.optics.aperture_points_mm(n_stop)
        metered_s, level = self.metered(n_stop)
        if exposure_s is not None:
            if not exposure_s > 0:
                raise ValueError(f"exposure must be positive, not {exposure_s:g} s")
            level *= exposure_s / metered_s
        open_s = metered_s if exposure_s is None else exposure_s
        latency_s = self.latency_s(shot_number)
        middle_t_s = trigger_t_s + latency_s + open_s / 2
        pose = None if self.path is None else self.path.pose(middle_t_s)

        lattice = self.lattice
        grid = Grid.of(self.sensor.shape, lattice)
        rendering = self.scene.render(self._rays(grid, points.reshape(-1, 2)), pose)
        radiance = rendering.radiance
        radiance *= np.float32(level / self.scene.mean_radiance)
        plane = self._masked(radiance, grid, lattice, points.reshape(-1, 2))
        raw = self.sensor.develop(plane, np.random.default_rng([self.seed, 3, shot_number]))
        exif = dng.Exif(
            make=MAKE,
            model=MODEL,
            serial=f"SIM{self.seed:08d}",
            focal_length_mm=self.optics.focal_length_mm,
            f_number=n_stop,
            exposure_s=open_s,
            iso=ISO,
            taken_utc_ns=round((self.epoch_utc_s + middle_t_s) * 1e9),
        )
        return SimulatedExposure(
            file=dng.encode(raw, black=self.sensor.black, white=self.sensor.white, exif=exif, mono=self.sensor.mono),
            mid_exposure_t_s=middle_t_s,
            latency_s=latency_s,
            raw=raw,
            _truth=partial(self._truth, rendering, grid=grid, points_mm=points, pose=pose, middle_t_s=middle_t_s),
        )

    def bench_frame(self, *, f_number: float | None = None, shot_number: int = 0) -> SimulatedExposure:
        """Photograph a white card for calibration: 1/8 of the aperture unless `f_number` is given."""
        bench = replace(self, scene=WhiteCard(), path=None)
        return bench.expose(0.0, shot_number, f_number=8 * self.optics.f_number if f_number is None else f_number)

    def _rays(self, grid: Grid, points_mm: NDArray[np.float64]) -> Rays:
        places = grid.places()
        y, x = (
            (place - (side - 1) / 2) * self.sensor.pitch_mm
            for place, side in zip(places, self.sensor.shape, strict=True)
        )
        return Rays(y, x, points_mm, self.optics.focal_length_mm, self.optics.focus_m)

    def _masked(self, radiance: Singles, grid: Grid, lattice: Lattice, points_mm: NDArray[np.float64]) -> Singles:
        weights = lens.modulation(self.optics.mask)
        orders = list(weights)
        k = np.array(orders, dtype=np.float64)
        centre = (np.array(self.sensor.shape) - 1) / 2
        shift = np.array(self.installed.shift_mm) * self.optics.mask.frequency_per_mm
        origin = 2 * np.pi * (k @ shift - k @ lattice.matrix() @ centre)
        angular = lens.angular_phases(self.optics, self.installed, orders, points_mm)
        sites = synthesis.GREY if self.sensor.mono else synthesis.SITES
        return synthesis.mosaic(
            radiance, grid, lattice, angular=angular, weights=weights, origin_phase=origin, sites=sites
        )

    def _truth(
        self,
        rendering: Rendering,
        *,
        grid: Grid,
        points_mm: NDArray[np.float64],
        pose: TruePose | None,
        middle_t_s: float,
    ) -> Truth:
        n = self.optics.aperture_samples
        views = synthesis.band_limited(rendering.radiance, grid)
        depth = None if rendering.depth_m is None else rendering.depth_m[grid.inner]
        installed, optics = self.installed, self.optics
        angular = optics.mask.frequency_per_mm * installed.distance_mm / optics.focal_length_mm
        return Truth(
            views=np.ascontiguousarray(np.moveaxis(views, 1, -1)).reshape(n, n, *views.shape[2:], 3),
            aperture_points_mm=points_mm,
            depth_m=depth,
            disparity_mm_per_mm=None if depth is None else optics.disparity_mm_per_mm(depth).astype(np.float32),
            pose=pose,
            mid_exposure_t_s=middle_t_s,
            kappa=angular * float(points_mm[-1, -1, 0] - points_mm[0, 0, 0]) * n / max(n - 1, 1),
            mask=optics.mask,
            mask_rotation_rad=installed.rotation_rad,
            mask_shift_mm=installed.shift_mm,
            mask_distance_mm=installed.distance_mm,
            angular_frequency_per_mm=angular,
            lattice=self.lattice,
            grid=np.array([[grid.step, 0, 0], [0, grid.step, 0]], dtype=np.float64),
        )


def reference_optics(law: str) -> Optics:
    """`geometric`: the reference camera, whose 25 carriers are physical. `fd`: an S5200 at 13 mm with Mask 2 (full)."""
    if law == "geometric":
        return Optics(50.0, 7.4, 6.7, Mask(15.5, 2), 0.48)
    if law == "fd":
        return Optics(13.0, 11.5, 1.13, Mask(11.38, 2), 1.01, law="fd")
    raise ValueError(f"no reference camera for the law {law!r}: there are geometric and fd")


def reference_camera(
    seed: int,
    *,
    scale: float = 1.0,
    scene: str | Path = "terrain",
    law: str = "geometric",
    path: FlightPath | None = None,
    epoch_utc_s: float = 1_781_517_600.0,
) -> MaskedCamera:
    """The camera of the demo and of the tests.

    `scale` is the sensor's side over 2776 × 3688. Under the geometric law the pitch stays 10 µm (a smaller chip); under
    `fd`, which counts bins on a chip, the chip stays 4.29 × 5.76 mm (larger pixels). `scene` is "terrain" (flown along
    `path`, by default the path of the same seed), "bench", "white", or a folder of n × n views.
    """
    optics = reference_optics(law)
    shape = round(2776 * scale / 2) * 2, round(3688 * scale / 2) * 2
    sensor = SensorModel(shape, 0.01 if law == "geometric" else 5.76 / shape[1])
    size_mm = shape[0] * sensor.pitch_mm, shape[1] * sensor.pitch_mm
    camera = MaskedCamera(seed, WhiteCard(), optics, sensor, None, epoch_utc_s=epoch_utc_s)
    finest = PASS * min(Grid.of(shape, camera.lattice).half_band)  # cycles/pixel
    if scene == "white":
        return camera
    if scene == "bench":
        return replace(camera, scene=boards(seed, optics, size_mm, sensor.pitch_mm, sensor.pitch_mm / finest))
    if scene == "terrain":
        flown = path or FlightPath(seed)
        period_m = finest_period_m(flown.height_m, sensor.pitch_mm, optics.focal_length_mm, finest)
        return replace(camera, scene=TerrainScene.of(seed, period_m), path=flown)
    views = RealViews.read(Path(scene), size_mm)
    return replace(camera, scene=views, optics=replace(optics, aperture_samples=len(views.views)))


@dataclass(frozen=True, slots=True)
class SensorModel:
    """The chip: an RGGB mosaic whose three colours are balanced (`mono`: without colour filters), 14 bits in 16.

    `shot_noise` and `read_noise_e` (electrons rms) are there to be switched off.
    """

    shape: tuple[int, int] = (2776, 3688)
    pitch_mm: float = 0.01
    black: int = 1024
    white: int = 15360
    full_well_e: float = 30_000.0
    shot_noise: bool = True
    read_noise_e: float = 6.0
    mono: bool = False

    @property
    def chip(self) -> Sensor:
        """Shape and pitch in the decoder's words."""
        return Sensor(self.shape, (self.pitch_mm, 0.0), (0.0, self.pitch_mm))

    def develop(self, plane: Singles, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Light (1.0 = white) as the numbers of the raw file, with noise, clipped at white."""
        electrons = plane * np.float32(self.full_well_e)
        variance = np.full((), self.read_noise_e**2, dtype=np.float32)
        if self.shot_noise:
            variance = variance + np.maximum(electrons, 0)
        if self.shot_noise or self.read_noise_e:
            electrons += np.sqrt(variance) * rng.standard_normal(plane.shape, dtype=np.float32)
        electrons *= np.float32((self.white - self.black) / self.full_well_e)
        electrons += np.float32(self.black + 0.5)
        return np.asarray(np.clip(electrons, 0, self.white), dtype=np.uint16)


@dataclass(frozen=True, slots=True)
class Truth:
    """What really was in front of the mask.

    `views` float32 (n, n, h, w, 3): what each aperture point saw, band-limited to a slice, in the plane's scale
    (1.0 = sensor white), scaled so that their mean is the frame's local mean. `aperture_points_mm` (n, n, 2) are
    those points (θy, θx). `depth_m` (h, w) along the axis and `disparity_mm_per_mm` (h, w), dx/dθ on the sensor, are
    None where the scene does not define them. `grid` (2, 3) leads from (y, x, 1) of a view to sensor (row, column).
    `kappa` = f_m·α·A: the used aperture in periods of the mask; 1 is the ideal. `lattice`: where the carriers lie.
    """

    views: Singles
    aperture_points_mm: NDArray[np.float64]
    depth_m: Singles | None
    disparity_mm_per_mm: Singles | None
    pose: TruePose | None
    mid_exposure_t_s: float
    kappa: float
    mask: Mask
    mask_rotation_rad: float
    mask_shift_mm: tuple[float, float]
    mask_distance_mm: float
    angular_frequency_per_mm: float
    lattice: Lattice
    grid: NDArray[np.float64]

    def save(self, path: Path) -> None:
        """All of it as an .npz file; what is None is left out."""
        arrays = {
            "views": self.views,
            "aperture_points_mm": self.aperture_points_mm,
            "grid": self.grid,
            "mid_exposure_t_s": self.mid_exposure_t_s,
            "kappa": self.kappa,
            "mask_rotation_rad": self.mask_rotation_rad,
            "mask_shift_mm": self.mask_shift_mm,
            "mask_distance_mm": self.mask_distance_mm,
            "lattice": self.lattice.matrix(),
        }
        if self.depth_m is not None and self.disparity_mm_per_mm is not None:
            arrays |= {"depth_m": self.depth_m, "disparity_mm_per_mm": self.disparity_mm_per_mm}
        if self.pose is not None:
            arrays |= {
                "position_ned_m": self.pose.position_ned_m,
                "attitude": self.pose.attitude,
                "geodetic": (self.pose.latitude_deg, self.pose.longitude_deg, self.pose.altitude_msl_m),
            }
        np.savez(path, **arrays)  # type: ignore[arg-type]  # savez takes whatever asarray takes
