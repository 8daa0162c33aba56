"""Try every law on one frame: which of them the frame's carriers obey, with the odds, or why none can be seen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dappled.decode.errors import DecodeError
from dappled.decode.optics import LAWS, Carrier, Lattice, Mask, MaskedOptics
from dappled.decode.optics.visibility import OrderStrength, order_strengths, under_stops
from dappled.decode.spectrum import Spectrum
from dappled.decode.spectrum.lattice import find_lattice
from dappled.decode.spectrum.mask_lattice import (
    ABOVE_FLOOR,
    MaskLattice,
    PeakList,
    asked_orders,
    find_mask_lattice,
    levels,
    should_stand,
)
from dappled.decode.spectrum.peaks import ALONE_NATS, measure, residual_bins
from dappled.findings import FRAME, Code, Finding, finding

# Chosen by hand where no figure stands beside a number; benchmarks/masks.py measures what all of them together make.

_ALIKE_BINS = 0.5  # rms from their lattice: peaks farther off belong to the scene
_SCALE_OFF = {"geometric": 0.06, "fd": 0.35}  # relative: no print, and no distance, is farther off than that
_STANDS_NATS = 3.5  # above what is around: a peak that is more than noise
_LACKING = 3  # orders missing, whatever the stop: fewer may be lost at its nulls
_PLAIN = 0.01  # of the mean: a carrier so strong stands out in any white frame
_THIRD = 2 ** (1 / 6)  # of a stop
_ENOUGH = 0.6  # of a mask's carriers: a lattice found without a prediction needs so many


@dataclass(frozen=True, slots=True)
class LawOdds:
    """What a frame says about one law: the log odds (nats) that the mask's carriers stand where the law allows.

    None where no two of the mask's carriers agree near the law's prediction.
    """

    law: str
    nats: float | None


@dataclass(frozen=True, slots=True)
class LawSearch:
    """What a frame shows under all laws.

    `found` is the lattice that chance is ruled out for, `law` the law near whose prediction it is; both None where
    there is none, and `unseen` says why. `expected` is whether carriers must be visible in this frame, whatever shape
    the stop has: then the absence of a lattice means that something is wrong.
    """

    odds: tuple[LawOdds, ...]
    found: MaskLattice | None
    law: str | None
    expected: bool
    unseen: Finding | None

    @property
    def log10_odds(self) -> dict[str, float | None]:
        """The odds against chance of what was found, and of the best lattice near each law's prediction."""
        nats = {"log10_odds": None if self.found is None else self.found.odds_nats}
        nats |= {f"log10_odds_{one.law}": one.nats for one in self.odds}
        return {name: None if one is None else one / math.log(10) for name, one in nats.items()}

    @property
    def sentence(self) -> str:
        """The odds of each law in words."""
        shown = "; ".join(
            f"{one.law} " + ("shows nothing" if one.nats is None else f"10^{one.nats / math.log(10):.0f} : 1")
            for one in self.odds
        )
        return f"odds against chance: {shown}"


def search_laws(
    spectrum: Spectrum,
    optics: MaskedOptics,
    *,
    focal_length_mm: float,
    f_number: float | None,
    anywhere: bool = False,
    other_laws: bool = True,
    narrowest_f: float | None = None,
) -> LawSearch:
    """Look for a mask's lattice in a whole spectrum near the prediction of each law; that of `optics` wins a tie.

    Where the f-number is unknown (None), no order must stand, and any may. With `anywhere` a full mask that shows
    nearly all of its carriers is found away from every prediction, too. Without `other_laws` only its own is tried.
    `narrowest_f` is the lens' narrowest stop, for the advice of the sentence.
    """
    peaks = PeakList.of(spectrum)
    odds: list[LawOdds] = []
    asked: list[list[OrderStrength]] = []
    sure: list[tuple[MaskLattice, str]] = []
    for name in (optics.law, *(other for other in LAWS if other != optics.law and other_laws)):
        predicted = optics.by(name).lattice(focal_length_mm)
        expected = order_strengths(optics, predicted, f_number)
        found = find_mask_lattice(peaks, predicted, expected)
        asked.append(expected)
        odds.append(LawOdds(name, None if found is None else found.odds_nats))
        if found is not None and found.sure:
            sure.append((found, name))
    advice = _advice(optics, optics.lattice(focal_length_mm), narrowest_f)
    expects, why = unseen(spectrum, asked, advice=advice, f_number=f_number)
    foreign: list[Finding] = []
    for lattice, name in sorted(sure, key=lambda one: -one[0].odds_nats):
        wrong = not_this_mask(
            spectrum,
            lattice,
            optics,
            f_number=f_number,
            most_scale=None if anywhere else _SCALE_OFF[name],
        )
        if wrong is None:
            return LawSearch(tuple(odds), lattice, name, expects, None)
        foreign.append(wrong)
    if foreign:
        return LawSearch(tuple(odds), None, None, True, foreign[0])
    best = _anywhere(spectrum, optics.mask) if anywhere and optics.mask.pattern == "full" else None
    if expects and len(peaks.prominence) and float(peaks.prominence.max()) > _STANDS_NATS:
        why = replace(why, code=Code.CARRIERS_OTHER_PEAKS)
    return LawSearch(tuple(odds), best, None, expects, None if best is not None else why)


def not_this_mask(
    spectrum: Spectrum,
    found: MaskLattice,
    optics: MaskedOptics,
    *,
    f_number: float | None,
    most_scale: float | None = None,
) -> Finding | None:
    """Why a lattice can't be that of this mask; None where it may be.

    `most_scale` is how far its size may be off the prediction (None: not judged). A pattern of the scene that has the
    mask's own period can't be told from it, however strong it is: a film of high contrast makes stronger carriers than
    its pattern.
    """
    off = found.scale - 1
    if most_scale is not None and abs(off) > most_scale:
        return finding(Code.CARRIERS_OTHER_SIZE, FRAME, off=off)
    strongest = max(m.strength for _, m in found.found)
    between = [Carrier(0, 0, fy, fx) for fy, fx in np.array([(0.5, 0.5), (0.5, -0.5)]) @ found.lattice.matrix()]
    halves = [one for one in measure(spectrum, between, 1.5, prominence_nats=ALONE_NATS) if one is not None]
    if len(halves) == 2 and min(one.strength for one in halves) > strongest:
        return finding(Code.CARRIERS_HALF_WAY, FRAME)
    if optics.mask.pattern == "diagonal" and (more := _as_full(spectrum, found)) is not None:
        return more
    expected = order_strengths(optics, found.lattice, f_number)
    orders = [one.order for one in expected]
    stops = under_stops(optics, found.lattice, orders, f_number)
    stand = sorted(should_stand(spectrum, expected), key=lambda one: -one.least)
    if not stand:
        return _lacking(spectrum, found, expected, stops)
    seen = measure(spectrum, found.lattice.carriers([one.order for one in stand]), 1.5, prominence_nats=ALONE_NATS)
    gone = [_name(one) for one, peak in zip(stand, seen, strict=True) if peak is None]
    if seen[0] is None and len(gone) > 1:
        return finding(Code.CARRIERS_SOME_ABSENT, FRAME, orders=_some(gone))
    return _lacking(spectrum, found, expected, stops)


def _as_full(spectrum: Spectrum, found: MaskLattice) -> Finding | None:
    """That (0, 1) and (1, 0), which a diagonal mask has not, are both stronger than its innermost orders; else None.

    Neither comes of a film that is not linear: what that adds to a diagonal mask has an even sum of orders.
    """
    inner, outer = (
        measure(spectrum, found.lattice.carriers(orders), 1.5, prominence_nats=ALONE_NATS)
        for orders in ([(0, 1), (1, 0)], [(1, 1), (1, -1)])
    )
    diagonal = max((one.strength for one in outer if one is not None), default=0.0)
    if all(one is not None and not one.suspect and one.strength > diagonal for one in inner):
        return finding(Code.CARRIERS_FULL_MASK, FRAME)
    return None


def _lacking(
    spectrum: Spectrum, found: MaskLattice, expected: Sequence[OrderStrength], stops: NDArray[np.float64]
) -> Finding | None:
    """The orders that are missing behind any stop that lets through as much as is seen of the others."""
    there = [i for i, one in enumerate(expected) if one.on_sensor and one.most > 0]
    orders = [expected[i].order for i in there]
    looked = found.lattice.carriers(orders)
    seen = measure(spectrum, looked, 1.5, prominence_nats=ALONE_NATS)
    gone = np.array([one is None for one in seen])
    if gone.sum() < _LACKING or gone.all():
        return None
    strength = np.array([0.0 if one is None else one.strength for one in seen])
    level = np.array(levels(spectrum, [expected[i] for i in there]))
    asked = stops[:, there]
    gain = np.median(strength[~gone] / np.maximum(asked[:, ~gone], 1e-12), axis=1)
    lacking = gone & (gain[:, None] * asked > ABOVE_FLOOR * level)
    likeliest = lacking[lacking.sum(axis=1).argmin()]
    if likeliest.sum() < _LACKING:
        return None
    names = _some([f"({ky}, {kx})" for (ky, kx), one in zip(orders, likeliest, strict=True) if one])
    return finding(Code.CARRIERS_LACKING, FRAME, orders=names)


def missing(spectrum: Spectrum, lattice: Lattice, optics: MaskedOptics, f_number: float) -> Finding | None:
    """Why a calibration's lattice can't be this frame's: most of the carriers due on it are not there.

    A peak or two near them may be the scene's.
    """
    expected = order_strengths(optics, lattice, f_number)
    there = should_stand(spectrum, expected)
    if not _spans(there):
        return None
    seen = measure(spectrum, lattice.carriers([one.order for one in there]), 3.0)
    stand = sum(one is not None for one in seen)
    if 2 * stand > len(there):
        return None
    orders = _some([_name(one) for one in there])
    due = len(there)
    return finding(Code.CARRIERS_MISSING, FRAME, orders=orders, f_number=f_number, missing=due - stand, due=due)


def unseen(
    spectrum: Spectrum, predictions: Sequence[Sequence[OrderStrength]], *, advice: str, f_number: float | None
) -> tuple[bool, Finding]:
    """(whether carriers must be visible, why no lattice is); `advice` says at which stop carriers are visible.

    `predictions` are one or more laws'; the finding is about the one under which most should be seen.
    """
    if f_number is None:
        some = asked_orders(max(predictions, key=lambda one: sum(order.on_sensor for order in one)))
        return False, finding(Code.CARRIERS_UNCONFIRMED, FRAME, orders=_some([_name(one) for one in some]))
    expected, above = max(
        ((list(one), should_stand(spectrum, one)) for one in predictions), key=lambda pair: len(pair[1])
    )
    causes: dict[str, list[str]] = {}
    for one in expected:
        if one not in above:
            causes.setdefault(one.cause or "below the frame's own detail and noise", []).append(_name(one))
    lost = "; ".join(f"{_some(orders)} {cause}" for cause, orders in causes.items())
    if _spans(above):
        orders = _some([_name(one) for one in above])
        return True, finding(Code.CARRIERS_UNSEEN, FRAME, orders=orders, f_number=f_number, not_expected=lost or "none")
    return False, finding(Code.CARRIERS_UNOBSERVABLE, FRAME, f_number=f_number, lost=lost, advice=advice)


def _advice(optics: MaskedOptics, lattice: Lattice, narrowest_f: float | None) -> str:
    """At which f-number a white frame must show a mask's carriers, whatever the stop's shape, and what the lens can."""

    def plain(f_number: float) -> list[OrderStrength]:
        seen = order_strengths(optics, lattice, f_number)
        return [one for one in seen if one.on_sensor and one.least > _PLAIN]

    ideal = optics.mask.frequency_per_mm * optics.distance_mm
    tried = ideal * _THIRD ** np.arange(-6, 19)
    needed = next((float(stop) for stop in tried if _spans(plain(float(stop)))), None)
    if needed is None:
        return f"this mask's carriers are weak at any; its ideal is f/{ideal:.1f}"
    asks = f"f/{needed:.0f} or smaller for this mask; its ideal is f/{ideal:.1f}"
    if narrowest_f is None or needed <= 1.03 * narrowest_f:
        return asks
    left = plain(narrowest_f)
    there = f"only {_some([_name(one) for one in left])} can be counted on" if left else "no carrier can be counted on"
    return (
        f"{asks}, but the lens ends at f/{narrowest_f:g}, where {there}: put a smaller hole before the lens, or take a "
        "coarser mask, see dappled mask design"
    )


def _spans(orders: Sequence[OrderStrength]) -> bool:
    return len(orders) > 1 and bool(np.linalg.matrix_rank([one.order for one in orders]) == 2)


def _name(one: OrderStrength) -> str:
    return f"({one.order[0]}, {one.order[1]})"


def _some(orders: Sequence[str]) -> str:
    return ", ".join(orders[:4]) + (f" and {len(orders) - 4} more" if len(orders) > 4 else "")


def _anywhere(spectrum: Spectrum, mask: Mask) -> MaskLattice | None:
    """The lattice of a full mask without a prediction, if the frame shows nearly all of its carriers."""
    try:
        lattice = find_lattice(spectrum).lattice
    except DecodeError:
        return None
    looked = [c for c in lattice.carriers(mask.half_orders()) if c.on_sensor and (c.ky, c.kx) != (0, 0)]
    found = [(c, m) for c, m in zip(looked, measure(spectrum, looked, 2.0), strict=True) if m is not None]
    if (
        len(found) <= _ENOUGH * len(looked)
        or residual_bins([c for c, _ in found], [m for _, m in found], spectrum) > _ALIKE_BINS
    ):
        return None
    return MaskLattice(lattice, tuple(found), 0.0, math.nan, math.nan)
