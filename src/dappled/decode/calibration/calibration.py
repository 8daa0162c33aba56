"""Calibrations: the measurements at each focal length, the lattice at any focal length, and whether the mask has moved.

The mean of slice k over a frame is T_k·A_k of the frame's mean, A_k real: parallax and texture average out, and a stop
that is its own mirror image has a real transform. A film that moved by δ periods since its calibration turns each mean
by 2πk·δ; one that turned makes the phase of each slice run across the frame. Blocks of the frame say how far their own
means scatter, so that texture is not taken for a move.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled import codec
from dappled.decode.errors import DecodeError
from dappled.decode.optics import LAWS, Lattice, Mask, MaskedOptics, Sensor
from dappled.findings import FRAME, Code, Finding, Level, finding

_KIND, _VERSION = "dappled calibration", 1
_MOST_HARMONICS = 20  # as a mask's profile
_BLOCKS = (6, 8)  # of a frame, whose scatter says how well a mean is known
_SURE = 30.0  # chi², or log likelihood: clean frames reach 3
_ALIKE = 1.0  # chi²: moves of a diagonal mask a quarter of a period apart differ by rounding alone
_STEPS = 48  # of a period: how finely moves are tried, up to a quarter of a period
_MOST_TURN, _TURNS = 0.007, 81  # radians to either side, and how many are tried
_AT_EDGE = 0.95  # of the farthest turn: the best may be beyond it
_LEAST_PERIODS, _LEAST_TURN = 0.03, 3e-4  # smaller moves cost next to nothing
_LEAST_TRANSFER = 1e-3  # a carrier that the mask doesn't make tells nothing
_FLOOR = 1e-3  # of the mean: what the scene adds to the mean of a slice, however still its blocks are


@dataclass(frozen=True, slots=True)
class SweptDistance:
    """The mask's distance times the print's scale in mm, with its standard error, as `swept_distance` finds it.
    `stops` are the f-numbers."""

    scaled_mm: float
    sigma_mm: float
    stops: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class LatticeFit:
    """What the frames of one focal length showed.

    `lattice` in cycles/pixel. `origin` is x0 in cycles of ky and kx, at the frame's centre. `transfer` holds M_k, real
    and signed, for each of the mask's half orders (DC first, 1.0), the aperture's own share divided out; 0 where that
    leaves too little to tell.
    `residual_bins` is the rms distance of the measured carriers from the lattice in bins of the padded transform,
    `phase_residual_rad` that of their phases from the origin's, `found` how many carriers of the half plane were seen;
    `seen` are those, without the mean: (ky, kx, fy, fx, strength). `print_scale` is the print's frequency over
    its design's, 1 where it can't be told from the distance.
    """

    focal_length_mm: float
    f_number: float
    lattice: Lattice
    rotation_rad: float
    mask_distance_mm: float
    distance_fitted: bool
    origin: tuple[float, float]
    transfer: tuple[float, ...]
    residual_bins: float
    phase_residual_rad: float
    found: int
    seen: tuple[tuple[int, int, float, float, float], ...] = ()
    print_scale: float = 1.0


@dataclass(frozen=True, slots=True)
class MaskMove:
    """How far a mask lies from where its calibration has it: in periods (ky, kx), and radians; 0 where nothing shows.

    A quarter of a period along each axis is the most that is told. A mask looks the same half a period off along
    either, a diagonal one a quarter off along both: the least move of all that look alike is told.
    """

    periods: tuple[float, float]
    turn_rad: float

    def findings(self, frequency_per_mm: float) -> tuple[Finding, ...]:
        """The move of a frame's mask, as findings."""
        return moved(self.periods, self.turn_rad, frequency_per_mm, farther=abs(self.turn_rad) > _AT_EDGE * _MOST_TURN)


def moved(
    periods: tuple[float, float], turn_rad: float, frequency_per_mm: float, *, farther: bool = False
) -> tuple[Finding, ...]:
    """How far a frame's mask of this frequency lies from where it was calibrated, in periods and radians; `farther`:
    turned at least so far."""
    found = []
    if any(periods):
        found.append(finding(Code.MASK_SHIFTED, FRAME, by_um=1e3 * math.hypot(*periods) / frequency_per_mm))
    if turn_rad:
        code = Code.MASK_TURNED_FARTHER if farther else Code.MASK_TURNED
        found.append(finding(code, FRAME, by_deg=abs(math.degrees(turn_rad))))
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera and mask as fitted; one or more focal lengths, rising. `shape` is the frames'.

    `pupil_mm` is the distance of the exit pupil beyond the focal length, v(f) = f + pupil, under `geometric`; `verdict`
    says which law explains the frames. `swept` is what their f-numbers say of the distance (None: nothing),
    `focal_sigma_mm` the standard error of their focal lengths. `overridden` is what speaks against the frames, and the
    user overrode: clipped pixels, a JPEG.
    """

    shape: tuple[int, int]
    law: str
    mask: Mask
    sensor: Sensor
    fits: tuple[LatticeFit, ...]
    pupil_mm: float = 0.0
    verdict: Finding | None = None
    swept: SweptDistance | None = None
    focal_sigma_mm: float = 0.0
    overridden: tuple[Finding, ...] = ()

    @property
    def doubts(self) -> tuple[Finding, ...]:
        """All that is doubtful about this calibration."""
        known = self.verdict
        told = known is None or known.level == Level.NOTE or any(one.code is known.code for one in self.overridden)
        return self.overridden if known is None or told else (known, *self.overridden)

    def nearest(self, focal_length_mm: float) -> LatticeFit:
        """The fit at the nearest focal length."""
        return min(self.fits, key=lambda f: abs(math.log(f.focal_length_mm / focal_length_mm)))

    def lattice_at(self, focal_length_mm: float) -> Lattice:
        """The lattice at a focal length: the law's, corrected as at the fits (linear between, constant beyond)."""
        lengths = [f.focal_length_mm for f in self.fits]
        corrections = [
            np.linalg.solve(self._law(f.focal_length_mm, f.mask_distance_mm), f.lattice.matrix()) for f in self.fits
        ]
        distances = [f.mask_distance_mm for f in self.fits]
        distance = float(np.interp(focal_length_mm, lengths, distances))
        correction = np.array(
            [[np.interp(focal_length_mm, lengths, [c[i, j] for c in corrections]) for j in (0, 1)] for i in (0, 1)]
        )
        return Lattice.of(self._law(focal_length_mm, distance) @ correction)

    def mask_move(
        self,
        slices: NDArray[np.complex64],
        orders: Sequence[tuple[int, int]],
        *,
        focal_length_mm: float,
        lattice: Lattice,
        samples_px: tuple[float, float],
    ) -> MaskMove:
        """How far a frame's slices complex64 (K, h, w), DC first, show the mask from where it was calibrated.

        `lattice` is where they were cut, `samples_px` how many pixels a slice's sample steps down and across. Where the
        stop averages all carriers away (an even square stop at the mask's ideal aperture) nothing can be told.
        """
        none = MaskMove((0.0, 0.0), 0.0)
        fit = self.nearest(focal_length_mm)
        magnitudes = dict(zip(self.mask.half_orders(), fit.transfer, strict=True))
        size = np.array([magnitudes[order] for order in orders])
        known = np.abs(size) > _LEAST_TRANSFER
        known[0] = False
        if min(slices.shape[1:]) < 2 * max(_BLOCKS) or known.sum() < 2:
            return none
        sums, places = _block_sums(slices, samples_px)
        whole = float(sums[:, 0].real.sum())
        if not whole > 0:
            return none
        k = np.array(orders, dtype=np.float64)[known]
        middle = (np.array(self.shape) - 1) / 2  # the origin's place; a slice's phase is that at pixel (0, 0)
        transfers = size[known] * np.exp(2j * np.pi * k @ (np.array(fit.origin) - lattice.matrix() @ middle))
        seen = sums[:, known] / whole / transfers  # (blocks, orders): each block's part of T_k·A_k / T_k
        shares = sums[:, :1].real / whole
        floor = (_FLOOR / np.abs(transfers)) ** 2
        turn = _turn_of(seen, shares, k, floor, lattice=lattice, sensor=self.sensor, places=places)
        return MaskMove(_shift(seen, shares, k, floor), turn)

    def _law(self, focal_length_mm: float, mask_distance_mm: float) -> NDArray[np.float64]:
        optics = MaskedOptics(self.sensor, self.mask, self.law, mask_distance_mm)
        return optics.lattice(focal_length_mm + self.pupil_mm).matrix()

    def to_dict(self) -> dict[str, Any]:
        """Plain values for a TOML file."""
        values = codec.table(replace(self, mask=replace(self.mask, film_px_per_mm=None)))
        del values["sensor"]["shape"]  # the frames'
        return {"kind": _KIND, "version": _VERSION, **values}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Calibration:
        """The inverse of `to_dict`; other tables may stand beside. Raises DecodeError, which names what is wrong."""
        if (values.get("kind"), values.get("version")) != (_KIND, _VERSION):
            raise DecodeError(f"this is not a calibration of version {_VERSION}: make one with `dappled calibrate`")
        known = {one.name: values[one.name] for one in fields(cls) if one.name in values}
        if isinstance(known.get("sensor"), Mapping) and "shape" in known:
            known["sensor"] = {"shape": known["shape"], **known["sensor"]}
        try:
            found = codec.read(cls, known)
        except codec.CodecError as error:
            raise DecodeError(f"the calibration is incomplete or wrong ({error}): calibrate again") from error
        if found.law not in LAWS:
            raise DecodeError(f"the calibration names the law {found.law!r}; known are {', '.join(LAWS)}")
        if not 1 <= found.mask.p <= _MOST_HARMONICS:  # its carriers grow with the square
            raise DecodeError(f"its mask.p is {found.mask.p}, not 1 to {_MOST_HARMONICS}: calibrate again")
        if not found.fits or any(len(f.transfer) != len(found.mask.half_orders()) for f in found.fits):
            raise DecodeError("the calibration's transfer doesn't fit its mask: calibrate again")
        return found


def _block_sums(
    slices: NDArray[np.complex64], samples_px: tuple[float, float]
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """(blocks, K) sums under a Hann window, and (blocks, 2) places in pixels from the frame's middle."""
    sides = slices.shape[1:]
    edges = [np.linspace(0, side, n + 1).astype(int) for side, n in zip(sides, _BLOCKS, strict=True)]
    windows = [np.hanning(side + 2)[1:-1] for side in sides]
    weights = [
        (window * (np.searchsorted(edge, np.arange(window.size), side="right") == np.arange(1, n + 1)[:, None]))
        for window, edge, n in zip(windows, edges, _BLOCKS, strict=True)
    ]
    down, across = (weight.astype(np.complex64) for weight in weights)
    summed = down @ (slices @ across.T)
    middles = [(edge[1:] + edge[:-1] - side) / 2 * px for edge, side, px in zip(edges, sides, samples_px, strict=True)]
    places = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 2)
    return summed.reshape(len(slices), -1).T.astype(np.complex128), places


def _shift(
    seen: NDArray[np.complex128], shares: NDArray[np.float64], k: NDArray[np.float64], floor: NDArray[np.float64]
) -> tuple[float, float]:
    """The shift (periods of ky, kx) that makes all means real; 0, 0 where they are so already, within their scatter."""
    means = seen.sum(axis=0)
    variance = (np.abs(seen - shares * means) ** 2).sum(axis=0) / 2 + floor
    axis = np.arange(-_STEPS // 4, _STEPS // 4 + 1) / _STEPS
    tried = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    left = ((means * np.exp(-2j * np.pi * tried @ k.T)).imag ** 2 / variance).sum(axis=1)
    alike = np.flatnonzero(left <= left.min() + _ALIKE)
    best = int(alike[np.hypot(*tried[alike].T).argmin()])
    y, x = (float(one) for one in tried[best])
    if float((means.imag**2 / variance).sum()) - float(left[best]) < _SURE or math.hypot(y, x) < _LEAST_PERIODS:
        return 0.0, 0.0
    return y, x


def _turn_of(
    seen: NDArray[np.complex128],
    shares: NDArray[np.float64],
    k: NDArray[np.float64],
    floor: NDArray[np.float64],
    *,
    lattice: Lattice,
    sensor: Sensor,
    places: NDArray[np.float64],
) -> float:
    """The turn about the frame's middle under which the blocks agree best; 0 where they agree without one."""
    to_sensor = np.array([sensor.row_mm, sensor.column_mm])
    per_mm = k @ lattice.matrix() @ np.linalg.inv(to_sensor).T
    tried = np.linspace(-_MOST_TURN, _MOST_TURN, _TURNS)
    scatter = []
    for angle in tried:
        c, s = math.cos(angle), math.sin(angle)
        off = per_mm @ (np.array([[c, s], [-s, c]]) - np.eye(2)) @ to_sensor.T
        turned = seen * np.exp(-2j * np.pi * places @ off.T)
        left = (np.abs(turned - shares * turned.sum(axis=0)) ** 2).sum(axis=0) + floor
        scatter.append(len(seen) * float(np.log(left).sum()))
    best = int(np.argmin(scatter))
    if scatter[_TURNS // 2] - scatter[best] < _SURE or abs(tried[best]) < _LEAST_TURN:
        return 0.0
    return float(tried[best])
