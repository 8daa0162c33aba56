"""A masked camera with the imperfections of real ones, ray by ray: continuous stop, printed film, sharp scene, chip.

`MaskedCamera` makes frames quickly for the demo, of scenes that suit a slice's band and a stop of as many points as
there are views. This one exists to say no: every imperfection that spoils views in practice is a parameter, and the
truth stands beside the frame. Nothing is band-limited; light is summed on a grid `finer` times the sensor's.

I(x) = Σ_θ w(θ) L_θ(x) · [1 + 2 Re Σ_k c_k·exp(2πi k·f·((1 − α)x + αθ + shift))], the sum over θ taken first for each k.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Singles
from dappled.decode.optics import Lattice, Mask
from dappled.mocks.scene import chip_faults
from dappled.mocks.scene.printed_mask import WAVELENGTH_MM, left_by_diffraction, printed
from dappled.mocks.scene.sharp_boards import FineGrid, SharpBoard, SharpScene
from dappled.mocks.scene.stops import StopPoints, StopShape, stop_points

_STRIP = 64  # rows of pixels at a time, so that memory holds them
MaskOrders = tuple[NDArray[np.int64], NDArray[np.complex128], NDArray[np.float64]]
WHITE = (SharpBoard(colour=(1.0, 1.0, 1.0), contrast=0.0),)
REAL_COLOURS = (
    (0.72, 0.22, 0.06),
    (0.16, 0.74, 0.10),
    (0.04, 0.26, 0.70),
)  # rows: what red, green, blue pixels take in
REAL_BOARDS = (
    SharpBoard(-0.012),
    SharpBoard(0.018, (-0.36, 0.10, -0.40, -0.04), (0.47, 0.30, 0.22)),
    SharpBoard(0.036, (-0.10, 0.38, -0.02, 0.36), (0.22, 0.30, 0.47), exponent=1.1),
)


@dataclass(frozen=True)
class RayCamera:
    """A camera, its mask and a scene. Lengths in mm, (y, x) on an upright picture, as in `lens`.

    Lens: the stop has the diameter v/`f_number`, v = `exit_pupil_mm` (None: the focal length, as if focused at infinity
    without zoom), the shape `stop`, and `points_per_view`² points in each cell of `views` × `views`. `defocus` is added
    to every board's disparity. `falloff` is the light lost at the corners, `cats_eye` how far a second equal stop seems
    shifted there, in diameters. `lens_diffraction` ends detail at 1/(λN).
    Film: `print_scale` times the design's frequencies, rows finer by `anisotropy`; `film` switches its own pixels,
    `mask_diffraction` the loss on the way to the sensor. `bow_mm`: the middle is so much farther from the sensor than
    the corners. `moved_mm` (in the mask's axes) and `turned_rad` came after the calibration.
    Chip: `level` is where the mean light is put (1.0 = white, clipped there), `colour_filters` None for a grey chip,
    else a matrix (`REAL_COLOURS` overlap); `full_well_e` 0 is noise-free; shares and rms as in `chip_faults`.
    """

    mask: Mask
    shape: tuple[int, int] = (240, 320)
    pitch_mm: tuple[float, float] = (0.01, 0.01)
    boards: tuple[SharpBoard, ...] = REAL_BOARDS
    seed: int = 0
    finer: int = 3

    focal_length_mm: float = 50.0
    exit_pupil_mm: float | None = None
    f_number: float = 7.44
    stop: StopShape = "round"
    blades: int = 6
    blade_turn_rad: float = 0.2
    views: int = 5
    points_per_view: int = 4
    defocus: float = 0.0
    falloff: float = 0.0
    cats_eye: float = 0.0
    lens_diffraction: bool = True

    mask_distance_mm: float = 0.48
    print_scale: float = 1.0
    anisotropy: float = 0.0
    film: bool = True
    mask_diffraction: bool = True
    turn_rad: float = 0.0
    shift_mm: tuple[float, float] = (0.0, 0.0)
    bow_mm: float = 0.0
    moved_mm: tuple[float, float] = (0.0, 0.0)
    turned_rad: float = 0.0

    level: float = 0.35
    colour_filters: tuple[tuple[float, float, float], ...] | None = None
    full_well_e: float = 30_000.0
    read_noise_e: float = 6.0
    hot_pixels: float = 0.0
    dust: int = 0
    gain_drift: float = 0.0
    banding: float = 0.0

    def __post_init__(self) -> None:
        """Raises ValueError for what no camera is."""
        if self.finer < 2.5 or self.points_per_view < 1 or not 0 < self.mask_distance_mm < self.v_mm:
            raise ValueError(
                "a ray camera needs a grid 2.5 times finer than its pixels, stop points, and a mask behind its lens"
            )
        if min(self.f_number, self.print_scale, self.level) <= 0 or min(self.shape) < 8:
            raise ValueError("f-number, print scale and level must be positive, and a frame 8 pixels high and wide")

    @property
    def v_mm(self) -> float:
        """Exit pupil to sensor."""
        return self.focal_length_mm if self.exit_pupil_mm is None else self.exit_pupil_mm

    @property
    def aperture_mm(self) -> float:
        """Diameter of the exit pupil."""
        return self.v_mm / self.f_number

    @property
    def alpha(self) -> float:
        """d / v in the middle of the field."""
        return self.mask_distance_mm / self.v_mm

    @property
    def kappa(self) -> float:
        """The used aperture in periods of the mask (rows): 1 is the ideal."""
        f = self.mask.frequency_per_mm * self.print_scale * (1 + self.anisotropy / 2)
        return f * self.alpha * self.aperture_mm

    @cached_property
    def grid(self) -> FineGrid:
        """Where the light is summed."""
        return FineGrid(self.shape, self.pitch_mm, self.finer)

    @cached_property
    def open_stop(self) -> StopPoints:
        """The stop's cells in shares of its diameter."""
        return stop_points(
            self.stop, self.views, self.points_per_view, blades=self.blades, turn_rad=self.blade_turn_rad
        )

    def calibration(self, f_number: float | None = None) -> RayCamera:
        """The same camera before a white card, before the mask moved."""
        n = self.f_number if f_number is None else f_number
        return replace(self, boards=WHITE, f_number=n, moved_mm=(0.0, 0.0), turned_rad=0.0, defocus=0.0)

    def orders(self) -> MaskOrders:
        """The mask's orders (K, 2) above (0, 0), their coefficients as light reaches the sensor, before stop and pixels
        (phase at the middle of the frame), and frequencies (K, 2) in cycles/mm on the film."""
        made = printed(
            self.mask,
            scale=self.print_scale,
            anisotropy=self.anisotropy,
            turn_rad=self.turn_rad + self.turned_rad,
            drawn=self.film,
        )
        strengths = made.amplitudes
        if self.mask_diffraction:
            strengths = strengths * left_by_diffraction(made.per_mm, self.mask_distance_mm)
        own = made.per_mm @ _turn(-(self.turn_rad + self.turned_rad))  # back in the mask's own axes
        place = own @ (np.array(self.shift_mm) + self.moved_mm)
        turned: NDArray[np.complex128] = np.exp(2j * np.pi * place)
        return made.orders, turned * strengths, made.per_mm

    def lattice(self) -> Lattice:
        """Where the carriers are, in cycles/pixel (in the middle of the field, where the film is bowed)."""
        f = self.mask.frequency_per_mm * self.print_scale * (1 - self.alpha)
        steps = np.diag([f * (1 + self.anisotropy / 2), f * (1 - self.anisotropy / 2)])
        return Lattice.of(steps @ _turn(self.turn_rad + self.turned_rad) * self.pitch_mm)

    def expose(self) -> RayFrame:
        """Take the picture."""
        colours = 1 if self.colour_filters is None else 3
        scene = SharpScene.of(
            self.boards,
            self.grid,
            self.aperture_mm,
            seed=self.seed,
            grey=colours == 1,
            defocus=self.defocus,
            cutoff_per_mm=1 / (WAVELENGTH_MM * self.f_number) if self.lens_diffraction else None,
        )
        light, views = self._summed(scene, colours)
        scale = np.float32(self.level / light.mean())
        light, views = light * scale, views * scale
        if self.colour_filters is not None:
            filters = np.array(self.colour_filters, dtype=np.float32)
            light = np.tensordot(filters, light, axes=1)
            views = np.einsum("ij,njhw->nihw", filters, views)
        plane = light[0] if colours == 1 else chip_faults.mosaic_of(light)
        rng = np.random.default_rng([self.seed, 32])
        if self.dust:
            plane = chip_faults.with_dust(plane, self.dust, rng)
        plane = chip_faults.with_noise(plane, self.full_well_e, self.read_noise_e, rng)
        plane = chip_faults.with_gain_drift(plane, self.gain_drift)
        if self.banding:
            plane = chip_faults.with_banding(plane, self.banding, rng)
        if self.hot_pixels:
            plane = chip_faults.with_hot_pixels(plane, self.hot_pixels, rng)
        clipped = float((plane >= 1).mean())
        n = self.views
        truth = RayTruth(
            camera=self,
            views=np.moveaxis(views, 1, -1).reshape(n, n, *self.shape, colours),
            view_weights=self.open_stop.view_weights(n),
            disparity=self.disparity(),
            clipped=clipped,
        )
        return RayFrame(np.clip(plane, 0, 1).astype(np.float32), truth)

    def _summed(self, scene: SharpScene, colours: int) -> tuple[Singles, Singles]:
        """(C, H, W) of light behind the mask on the pixels, and (N², C, H, W) the mean of each view's cell."""
        stop = self.open_stop
        theta = stop.points * self.aperture_mm
        _, _, per_mm = self.orders()
        alphas = self._alphas()
        nodes = np.unique(np.linspace(alphas.min(), alphas.max(), 3))  # one, where the film is flat
        phases = [np.exp(2j * np.pi * node * theta @ per_mm.T).T * stop.weights for node in nodes]
        in_view = (stop.view == np.arange(self.views**2)[:, None]) * stop.weights
        kernel = np.concatenate([*(part for p in phases for part in (p.real, p.imag)), in_view]).astype(np.float32)
        open_share = stop.view_weights(self.views).astype(np.float32).reshape(-1, 1, 1, 1)
        behind = np.empty((colours, *self.shape), dtype=np.float32)
        views = np.empty((self.views**2, colours, *self.shape), dtype=np.float32)
        for top in range(0, self.shape[0], _STRIP):
            pixels = slice(top, min(top + _STRIP, self.shape[0]))
            rows = slice(pixels.start * self.finer, pixels.stop * self.finer)
            sums = self._angular(scene, theta, kernel, rows, colours)
            cells = sums[-(self.views**2) :]
            light = self._behind_mask(sums, cells.sum(axis=0), nodes, rows)
            behind[:, pixels] = self.grid.on_pixels(light)
            with np.errstate(invalid="ignore"):  # no light through a closed cell: 0/0, NaN
                views[:, :, pixels] = self.grid.on_pixels(cells) / open_share
        return behind, views

    def _angular(
        self, scene: SharpScene, theta: NDArray[np.float64], kernel: Singles, rows: slice, colours: int
    ) -> Singles:
        """(R, C, rows, columns): light summed over the aperture's points, weighted by each row of a kernel (R, J)."""
        shape = (colours, rows.stop - rows.start, self.grid.shape[1])
        if scene.flat and self.cats_eye == 0:  # every point sees the same
            light = np.zeros(shape, dtype=np.float32)
            scene.at_height(0.0, rows).seen_from(0.0, light)
            self._vignette(theta[0], light, rows)
            return np.asarray(kernel.sum(axis=1)[:, None, None, None] * light)
        sums = np.zeros((len(kernel), math.prod(shape)), dtype=np.float32)
        for height in np.unique(theta[:, 0]):
            line = np.flatnonzero(theta[:, 0] == height)
            seen = scene.at_height(height, rows)
            lights = np.zeros((len(line), *shape), dtype=np.float32)
            for one, out in zip(theta[line], lights, strict=True):
                seen.seen_from(one[1], out)
                self._vignette(one, out, rows)
            sums += kernel[:, line] @ lights.reshape(len(line), -1)
        return sums.reshape(len(kernel), *shape)

    def _behind_mask(self, sums: Singles, light: Singles, nodes: NDArray[np.float64], rows: slice) -> Singles:
        """The light (C, rows, columns) with every order's wave added to its mean."""
        _, strengths, per_mm = self.orders()
        alphas = self._alphas()
        if len(nodes) > 1:
            alphas = alphas[rows]
        y, x = self.grid.places_mm
        at_y, at_x = y[rows, None] * (1 - alphas), x[None, :] * (1 - alphas)
        blend = _lagrange(alphas, nodes)
        k = len(strengths)
        for number in range(k):
            cycles = per_mm[number, 0] * at_y + per_mm[number, 1] * at_x
            wave = (2 * strengths[number] * np.exp(2j * np.pi * cycles)).astype(np.complex64)
            for node, share in enumerate(blend):
                base = 2 * k * node + number
                light += (sums[base] * wave.real - sums[base + k] * wave.imag) * share
        return light

    def _alphas(self) -> NDArray[np.float64]:
        """d/v, (1, 1) for a flat film, else on the fine grid."""
        if self.bow_mm == 0:
            return np.full((1, 1), self.alpha)
        y, x = self.grid.places_mm
        share = (y[:, None] ** 2 + x[None, :] ** 2) / (y[0] ** 2 + x[0] ** 2)
        return np.asarray((self.mask_distance_mm - self.bow_mm * share) / self.v_mm)

    def _vignette(self, theta: NDArray[np.float64], light: Singles, rows: slice) -> None:
        """Take what the lens loses towards the corners from the light of one aperture point."""
        if self.falloff == 0 and self.cats_eye == 0:
            return
        y, x = self.grid.places_mm
        corner = math.hypot(y[0], x[0])
        y = y[rows]
        if self.falloff:
            light *= (1 - self.falloff * (y[:, None] ** 2 + x[None, :] ** 2) / corner**2).astype(np.float32)
        if self.cats_eye:
            shift = self.cats_eye * self.aperture_mm / corner
            reach = np.hypot(theta[0] + shift * y[:, None], theta[1] + shift * x[None, :])
            light *= reach <= self.aperture_mm / 2

    def disparity(self) -> Singles:
        """(H, W) dx/dθ as the middle of the stop sees it."""
        out = np.zeros(self.shape, dtype=np.float32)
        for board in self.boards:
            top, bottom, left, right = board.extent or (-1.0, 1.0, -1.0, 1.0)
            y, x = ((np.arange(n) + 0.5) / n - 0.5 for n in self.shape)
            inside = ((y >= top) & (y <= bottom))[:, None] & ((x >= left) & (x <= right))[None, :]
            out[inside] = board.disparity + self.defocus
        return out


@dataclass(frozen=True)
class RayTruth:
    """What the camera really was and saw.

    `views` float32 (n, n, H, W, C): the mean light over each cell of the stop's square, pixel by pixel, in the plane's
    scale, NaN where the cell is closed; C is 1 for a grey chip, else what pixels of each colour see.
    `view_weights` (n, n) sum to 1. `disparity` (H, W) is dx/dθ. `clipped`: share of pixels at white.
    """

    camera: RayCamera = field(repr=False)
    views: Singles
    view_weights: NDArray[np.float64]
    disparity: Singles
    clipped: float


@dataclass(frozen=True)
class RayFrame:
    """A frame (H, W), linear, 1.0 = white, and its truth."""

    plane: Singles
    truth: RayTruth = field(repr=False)

    def jpeg(self, quality: int = 90) -> bytes:
        """What the body's own processing makes of it: colours interpolated, sRGB's curve, JPEG."""
        grey = self.truth.camera.colour_filters is None
        return chip_faults.jpeg_of(self.plane if grey else chip_faults.demosaiced(self.plane), quality)

    def raw(self, black: int = 1024, white: int = 15360) -> NDArray[np.uint16]:
        """The numbers of a raw file."""
        return np.asarray(np.rint(black + self.plane * (white - black)), dtype=np.uint16)


def _turn(angle_rad: float) -> NDArray[np.float64]:
    """(2, 2): rows @ it are turned from the row axis to the column axis."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, s], [-s, c]])


def _lagrange(at: NDArray[np.float64], nodes: NDArray[np.float64]) -> list[Singles]:
    """The weights, of `at`'s shape, that interpolate between values at the nodes."""
    found = []
    for i, node in enumerate(nodes):
        others = [(at - other) / (node - other) for j, other in enumerate(nodes) if j != i]
        found.append(np.prod(others, axis=0).astype(np.float32) if others else np.ones((1, 1), dtype=np.float32))
    return found
