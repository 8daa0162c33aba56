"""Model what the slices of a masked frame hold of a scene at one disparity.

A scene at one disparity D is s(x − D·θ) from aperture point θ. At spatial frequency f the band around carrier k then
holds, with W the stop's transform (see `aperture`) and T_k the carrier's transfer,

    slice_k(f) = Σ_m T_{k−m} W(ω_{k−m} − D·g_m) ŝ(g_m),   g_m = f + F_m,

F_m being the carrier's frequency of order m. The term m = 0 is the band's own detail. The others are detail beyond the
band, which the mask multiplies before the sensor samples, so that it folds into other bands. W is that of the whole
stop: a continuous one has angular orders that no carrier measures, and they are contained in it. View v, the mean over
its cell of the stop, holds W_v(−D·f) ŝ(f).

T_k is real but for the phase that the mask's place gives it, which slices can be turned back by (`upright`); the stop
has a centre of symmetry, so that W is real, and what opposite views hold is conjugate: of sums and differences of two
it is real, too (`view_pairs`). Everything that is computed of the model then has a fourth of the products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.decode.array_types import Complexes, Floats
from dappled.decode.joint.view_pairs import paired
from dappled.decode.lightfield.aperture import Aperture
from dappled.decode.optics import Order

Terms = NDArray[Any]
"""Of what slices hold, in single precision: real where they are turned back."""
# Squared deviations, as in `aperture`: boards 100 px apart before each other leave up to 8, and have 34.4 dB where that
# is taken off, 38.6 else.
_EVIDENCE = 9.0
_WAVES = 2  # of the longest waves over a frame, those that a Hann window parts from its mean


@dataclass(frozen=True, slots=True, eq=False)
class SliceModel:
    """The carriers of the whole plane: `orders` (A, 2), `transfers` (A,), `angular` ω (A, 2) in cycles over the
    aperture, `carriers` F (A, 2) in cycles per sensor column, both axes; and the `aperture`. Disparities are in sensor
    columns over the whole aperture. Slices are turned back by `turns` (A,) of unit size: by none, and transfers are
    complex, or by all (`upright`), and they are real, as all that is computed with them."""

    orders: NDArray[np.int64]
    transfers: NDArray[Any]
    angular: Floats
    carriers: Floats
    aperture: Aperture
    turns: NDArray[np.complex128]

    @classmethod
    def of_half(
        cls,
        orders: Sequence[Order],
        transfers: NDArray[np.complex128],
        angular: Floats,
        carriers: Floats,
        aperture: Aperture,
    ) -> SliceModel:
        """The model of a half plane's carriers, DC first: their conjugates are added behind them."""
        half = np.asarray(orders, dtype=np.int64).reshape(-1, 2)
        return cls(
            np.concatenate([half, -half[1:]]),
            np.concatenate([transfers, transfers[1:].conj()]),
            np.concatenate([angular, -angular[1:]]),
            np.concatenate([carriers, -carriers[1:]]),
            aperture,
            np.ones(2 * len(half) - 1, dtype=np.complex128),
        )

    def upright(self) -> SliceModel:
        """The same for slices that are turned back by the phases of the transfers."""
        size = np.abs(self.transfers)
        turns = np.where(size > 0, self.transfers / np.where(size > 0, size, 1), 1)
        return replace(self, transfers=size, turns=self.turns * turns)

    @property
    def half(self) -> list[Order]:
        """The orders of the half plane, DC first."""
        return [(int(ky), int(kx)) for ky, kx in self.orders[: (len(self.orders) + 1) // 2]]

    def common(self) -> NDArray[Any]:
        """(A,) what each slice holds of a scene without texture, over what slice (0, 0) holds."""
        return np.asarray(self.transfers * self.aperture.transform(self.angular).real)

    def unlike(self, slices: Complexes) -> tuple[NDArray[np.complex128], float]:
        """By what share of the scene's light slices (K, h, w), the half plane's, are brighter than `common` says, (K,),
        and the rms error of that, over the transfers.

        A wrong aperture does so, to all of the frame alike: by the means. Over the transfers what it leaves is real, as
        a stop has no direction; of parallax only what grows with its square is. That is told by the longest waves of
        the frame, and means that three of its standard errors explain tell nothing.
        """
        transfers = self.transfers[: len(slices)]
        along = np.arange(-_WAVES, _WAVES + 1)
        down, across = (
            np.exp(-2j * np.pi * np.outer(along, np.arange(side) / side)) * np.hanning(side + 2)[1:-1]
            for side in slices.shape[1:]
        )
        over = (slices * (1 / transfers).astype(np.complex64)[:, None, None]).real
        waves = (down.real @ over + 1j * (down.imag @ over)) @ across.T
        mean = float(waves[0, _WAVES, _WAVES].real)
        if not mean > 0:
            return np.zeros(len(slices), dtype=np.complex128), 0.0
        common = self.aperture.transform(self.angular[: len(slices)]).real
        beside = (waves - common[:, None, None] * waves[0]) / mean
        longest = np.maximum(np.abs(along)[:, None], np.abs(along)) == _WAVES
        means, weights = beside[:, _WAVES, _WAVES].real, np.abs(transfers) ** 2
        weights[0] = 0
        power = weights @ means**2
        around = float(weights @ (np.abs(beside[:, longest]) ** 2).mean(axis=1))
        share = max(0.0, 1 - _EVIDENCE * around / power) if power else 0.0
        return share * means * transfers, float(np.sqrt(share * around / weights.sum()))

    def alone(self) -> Terms:
        """(A, V·U) what the slices hold of detail that a view has alone, of unit spectrum, the views in pairs."""
        return single(self.transfers[:, None] * paired(self.aperture.cells(-self.angular)))

    def seen(self, frequencies: Floats, disparities: Floats) -> Terms:
        """(D, F, A) each band's own detail in the slices, of a scene of unit spectrum at each disparity."""
        return single(self.transfers * self._through(self.angular, frequencies, disparities))

    def _through(self, angular: Floats, frequencies: Floats, disparities: Floats) -> Floats:
        """(D, F, n) W(ω − D·g) of the stop, for ω (n, 2) and g (F, 2)."""
        at = angular - disparities[:, None, None, None] * frequencies[:, None]
        return self.aperture.transform(at.reshape(-1, 2)).real.reshape(at.shape[:-1])

    def viewed(self, frequencies: Floats, disparities: Floats) -> Complexes:
        """(D, F, V·U) the same in the views. A view whose cell is closed sees what its middle would."""
        found = _viewed(self.aperture, frequencies.tobytes(), disparities.tobytes())
        return found.reshape(len(disparities), len(frequencies), -1)

    def folds(self, frequencies: Floats, disparities: Floats) -> list[Fold]:
        """Detail that folds in from beyond the band, at any of these disparities with equal odds."""
        places = {(int(ky), int(kx)): n for n, (ky, kx) in enumerate(self.orders)}
        steps = {(a[0] - b[0], a[1] - b[1]) for a in places for b in places} - {(0, 0)}
        lattice = np.linalg.lstsq(self.orders.astype(np.float64), self.carriers, rcond=None)[0]
        found = []
        for step in sorted(steps):
            pairs = [(n, places.get((ky - step[0], kx - step[1]))) for (ky, kx), n in places.items()]
            to, source = np.array([(n, other) for n, other in pairs if other is not None]).T
            out = frequencies + np.array(step) @ lattice
            through = self._through(self.angular[source], out, disparities)
            turned = self.turns[source] * self.turns[to].conj()  # but for a sign, the same for all of them
            signs = np.where((turned * turned[0].conj()).real < 0, -1, 1)
            waves = self.transfers[source] * signs * through / np.sqrt(len(disparities))
            each = single(waves).transpose(1, 2, 0)
            found.append(Fold(to, out, each @ each.conj().transpose(0, 2, 1)))
        return found


def single(values: NDArray[Any]) -> Terms:
    """The values in single precision."""
    return values.astype(np.complex64 if np.iscomplexobj(values) else np.float32)


@lru_cache(maxsize=8)  # the frames of a flight have these in common, whatever aperture each was fitted
def _viewed(aperture: Aperture, frequencies: bytes, disparities: bytes) -> Complexes:
    """(D·F, V·U) what the views hold of frequencies (F, 2) at disparities (D,), both float64."""
    at = np.frombuffer(frequencies).reshape(-1, 2)
    at = (-np.frombuffer(disparities)[:, None, None] * at).reshape(-1, 2)
    share = aperture.cells(np.zeros((1, 2)))[0].real
    closed = share <= 1e-6
    cells = aperture.cells(at) / np.where(closed, 1, share)
    cells[:, closed] = np.exp(2j * np.pi * at @ aperture.points()[closed].T)
    made = cells.astype(np.complex64)
    made.flags.writeable = False
    return made


@dataclass(frozen=True, slots=True, eq=False)
class Fold:
    """Detail at `beyond` (F, 2), in cycles per sensor column, that folds into the slices `into` (n,):
    `covariance` (F, n, n) of unit spectrum."""

    into: NDArray[np.int64]
    beyond: Floats
    covariance: Terms


def folded(folds: Sequence[Fold], powers: Sequence[Floats], slices: int) -> Terms:
    """(F, A, A) covariance of folded detail of these powers (F,) in A slices."""
    total = np.zeros((len(powers[0]), slices, slices), dtype=folds[0].covariance.dtype)
    for fold, power in zip(folds, powers, strict=True):
        total[:, fold.into[:, None], fold.into[None, :]] += fold.covariance * power.astype(np.float32)[:, None, None]
    return total
