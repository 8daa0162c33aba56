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

from dappled.config import profiles
from dappled.decode.array_types import Singles
from dappled.decode.optics import Lattice, Mask, Sensor
from dappled.mocks.autopilot.path import FlightPath, TruePose
from dappled.mocks.scene import dng, lens, synthesis
from dappled.mocks.scene.bench import RealViews, WhiteCard, boards
from dappled.mocks.scene.flyover import TerrainScene, finest_period_m
from dappled.mocks.scene.lens import Installation, Optics, Rays, Rendering, Scene
from dappled.mocks.scene.opening import Opening
from dappled.mocks.scene.synthesis import PASS, Grid

MAKE, MODEL = "dappled", "Simulated Masked Camera"
ISO = 100
EXPOSURE_S = 1 / 1000  # metered, in ordinary light at full aperture
LEVEL = 0.4  # of white, where a scene's mean is metered
BRIGHTEST = 0.92  # of white, where the brightest pixel is kept
PRINT_SCALE = 1.003  # of a real camera's film
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
    `epoch_utc_s` is what the body's own clock shows at the simulation's start, `name` its make and model. `real`: the
    stop is round and open everywhere, and the scene's detail does not end where a slice's band does.
    """

    seed: int
    scene: Scene
    optics: Optics
    sensor: SensorModel
    path: FlightPath | None = None
    installation: Installation | None = None
    epoch_utc_s: float = 1_781_517_600.0
    name: tuple[str, str] = (MAKE, MODEL)
    real: bool = False

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
        opening = self._opening(f_number)
        peak = lens.peak_over_mean(self.optics, self.installed, opening.points_mm, opening.shares)
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
        opening = self._opening(n_stop)
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
        grid = Grid.of(self.sensor.shape, lattice, sharp=self.real and self.path is not None)
        rendering = self.scene.render(self._rays(grid, opening.nodes_mm), pose)
        radiance = rendering.radiance
        radiance *= np.float32(level / self.scene.mean_radiance)
        plane = self._masked(radiance, grid, lattice, opening)
        raw = self.sensor.develop(plane, np.random.default_rng([self.seed, 3, shot_number]))
        exif = dng.Exif(
            make=self.name[0],
            model=self.name[1],
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
            _truth=partial(self._truth, rendering, grid=grid, f_number=n_stop, pose=pose, middle_t_s=middle_t_s),
        )

    def bench_frame(self, *, f_number: float | None = None, shot_number: int = 0) -> SimulatedExposure:
        """Photograph a white card for calibration: 1/8 of the aperture unless `f_number` is given."""
        bench = replace(self, scene=WhiteCard(), path=None)
        return bench.expose(0.0, shot_number, f_number=8 * self.optics.f_number if f_number is None else f_number)

    def _opening(self, f_number: float) -> Opening:
        if self.real:
            return Opening.round(self.optics.used_aperture_mm(f_number), self.optics.aperture_samples)
        return Opening.of_beams(self.optics.aperture_points_mm(f_number))

    def _rays(self, grid: Grid, points_mm: NDArray[np.float64]) -> Rays:
        places = grid.places()
        y, x = (
            (place - (side - 1) / 2) * self.sensor.pitch_mm
            for place, side in zip(places, self.sensor.shape, strict=True)
        )
        return Rays(y, x, points_mm, self.optics.focal_length_mm, self.optics.focus_m)

    def _masked(self, radiance: Singles, grid: Grid, lattice: Lattice, opening: Opening) -> Singles:
        weights = lens.modulation(self.optics.mask)
        orders = list(weights)
        k = np.array(orders, dtype=np.float64)
        centre = (np.array(self.sensor.shape) - 1) / 2
        shift = np.array(self.installed.shift_mm) * self.optics.mask.frequency_per_mm
        origin = 2 * np.pi * (k @ shift - k @ lattice.matrix() @ centre)
        angular = opening.angular(self.optics, self.installed, orders)
        sites = synthesis.GREY if self.sensor.mono else synthesis.SITES
        return synthesis.mosaic(
            radiance, grid, lattice, angular=angular, weights=weights, origin_phase=origin, sites=sites
        )

    def _truth(
        self,
        rendering: Rendering,
        *,
        grid: Grid,
        f_number: float,
        pose: TruePose | None,
        middle_t_s: float,
    ) -> Truth:
        n = self.optics.aperture_samples
        points_mm = self.optics.aperture_points_mm(f_number)
        views = synthesis.band_limited(self._opening(f_number).seen(rendering.radiance), grid)
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
    real: bool = False,
) -> MaskedCamera:
    """The camera of the demo (`real`) and of the tests.

    `scale` is the sensor's side over 2776 × 3688. Under the geometric law the pitch stays 10 µm (a smaller chip); under
    `fd`, which counts bins on a chip, the chip stays 4.29 × 5.76 mm (larger pixels). `scene` is "terrain" (flown along
    `path`, by default the path of the same seed), "bench", "white", or a folder of n × n views. A `real` one
    has a round stop, detail beyond a slice's band on terrain, and a film printed 0.3 % too fine.
    """
    optics = reference_optics(law)
    if real:
        optics = replace(optics, mask=as_printed(optics.mask))
    shape = round(2776 * scale / 2) * 2, round(3688 * scale / 2) * 2
    sensor = SensorModel(shape, 0.01 if law == "geometric" else 5.76 / shape[1])
    camera = MaskedCamera(seed, WhiteCard(), optics, sensor, None, epoch_utc_s=epoch_utc_s, real=real)
    return _before(scene, camera, path)


def as_printed(mask: Mask) -> Mask:
    """The mask as a printer makes it that is 0.3 % off."""
    return replace(mask, frequency_per_mm=mask.frequency_per_mm * PRINT_SCALE)


EOS_450D = ("Canon", "Canon EOS 450D")


def eos450d_camera(
    seed: int,
    mask: Mask,
    *,
    scene: str | Path = "terrain",
    path: FlightPath | None = None,
    epoch_utc_s: float = 1_781_517_600.0,
    real: bool = False,
) -> MaskedCamera:
    """The thesis' Canon EOS 450D with a 50 mm lens and a printed mask 1.01 mm before its chip; DNG files of 24.5 MB.

    Its carriers stand where the law of its profile puts them. The lens opens until the aperture is one period of the
    mask wide. `scene`, `path` and `real` as in `reference_camera`. Raises ValueError for a mask whose carriers lie too
    near together or too far apart to be simulated.
    """
    distance_mm, focal_length_mm = 1.01, 50.0
    widest_mm = focal_length_mm / (mask.frequency_per_mm * distance_mm)
    film = as_printed(mask) if real else mask
    law = profiles.camera("canon-eos-450d").law
    optics = Optics(focal_length_mm, focal_length_mm / widest_mm, widest_mm, film, distance_mm, law=law)
    sensor = SensorModel((2856, 4290), 0.0051948051948, white=15319)
    camera = MaskedCamera(seed, WhiteCard(), optics, sensor, None, epoch_utc_s=epoch_utc_s, name=EOS_450D, real=real)
    return _before(scene, camera, path)


def eos450d_f_number(camera: MaskedCamera) -> float:
    """The stop at which that lens shows the mask's carriers: f/22, for the finest masks f/32."""
    return 22.0 if camera.optics.f_number < 22 else 32.0


def _before(scene: str | Path, camera: MaskedCamera, path: FlightPath | None) -> MaskedCamera:
    """The camera before a scene: "terrain" (flown along `path`), "bench", "white", or a folder of views."""
    optics, sensor, seed = camera.optics, camera.sensor, camera.seed
    size_mm = sensor.shape[0] * sensor.pitch_mm, sensor.shape[1] * sensor.pitch_mm
    finest = PASS * min(Grid.of(sensor.shape, camera.lattice).half_band)  # cycles/pixel
    if scene == "white":
        return camera
    if scene == "bench":
        return replace(camera, scene=boards(seed, optics, size_mm, sensor.pitch_mm, sensor.pitch_mm / finest))
    if scene == "terrain":
        flown = path or FlightPath(seed)
        if camera.real:
            finest = 0.45 / Grid.of(sensor.shape, camera.lattice, sharp=True).step  # what its grid holds
        period_m = finest_period_m(flown.height_m, sensor.pitch_mm, optics.focal_length_mm, finest)
        return replace(camera, scene=TerrainScene.of(seed, period_m, sharp=camera.real), path=flown)
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
