"""Check that a frame's carriers stand where its slices are cut: near another law, elsewhere, or another mask's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dappled.decode.calibration.law_search import LawSearch, missing, not_this_mask, search_laws
from dappled.decode.decoder import DecodeReport, MaskDecoder
from dappled.decode.optics import Carrier, Lattice
from dappled.decode.spectrum import Spectrum
from dappled.decode.spectrum.mask_lattice import MaskLattice
from dappled.decode.spectrum.peaks import Measured
from dappled.decode.spectrum.transform import Source, transform
from dappled.findings import FRAME, Code, Finding, finding


@dataclass(frozen=True, slots=True)
class LawCheck:
    """What a check says of a frame: `decoder` is the one to decode it with, which may be at another lattice.

    `search` is what the frame shows under the laws, where they were tried. `contradiction` says that
    carriers should be visible and are not, or stand elsewhere; `unsettled` what can't be told, or is strange about
    carriers that are there. None where there is no such reason for doubt.
    """

    decoder: MaskDecoder
    search: LawSearch | None = None
    contradiction: Finding | None = None
    unsettled: Finding | None = None


@dataclass(frozen=True, slots=True)
class FrameLens:
    """A frame's focal length, its f-number (None: unknown), and the narrowest stop of the lens, where it is known."""

    focal_length_mm: float
    f_number: float | None
    narrowest_f: float | None = None


def check_report(
    decoder: MaskDecoder, plane: Source, report: DecodeReport, lens: FrameLens, *, keep_law: bool
) -> LawCheck:
    """`check` for a frame that was decoded."""
    pairs = list(zip(report.predicted, report.measured, strict=True))
    orders = np.array([(c.ky, c.kx) for c in report.used], dtype=np.float64)
    at = np.array([(c.fy, c.fx) for c in report.used])
    used = Lattice.of(np.linalg.lstsq(orders, at, rcond=None)[0])
    return check(decoder, plane, lens, used, pairs, carriers_from=report.carriers_from, keep_law=keep_law)


def check(
    decoder: MaskDecoder,
    plane: Source,
    lens: FrameLens,
    used: Lattice,
    pairs: Sequence[tuple[Carrier, Measured | None]],
    *,
    carriers_from: str,
    keep_law: bool,
) -> LawCheck:
    """Check the lattice `used` of a frame, with what was measured near each prediction (`pairs`) and where the lattice
    came from (see DecodeReport). With `keep_law` carriers that obey another law are a contradiction, and not used."""
    if carriers_from == "measured":
        return LawCheck(decoder, unsettled=_foreign(decoder, plane, used, pairs, lens))
    if carriers_from == "calibrated":
        contradiction = None if lens.f_number is None else _missing(decoder, plane, lens.focal_length_mm, lens.f_number)
        if contradiction is None and lens.f_number is not None:
            return LawCheck(decoder)
        found = _searched(replace(decoder, calibration=None), plane, lens, keep_law=keep_law)
        if found.search is None or found.search.found is None or found.contradiction is not None:
            unsettled = None if lens.f_number is not None else found.unsettled
            return LawCheck(decoder, found.search, contradiction or found.contradiction, unsettled)
        if contradiction is None and _alike(found.search.found.lattice, decoder.lattice_at(lens.focal_length_mm)):
            return LawCheck(decoder)
        return replace(found, contradiction=finding(Code.CARRIERS_ELSEWHERE, FRAME))
    return _searched(decoder, plane, lens, keep_law=keep_law)


def _searched(decoder: MaskDecoder, plane: Source, lens: FrameLens, *, keep_law: bool) -> LawCheck:
    search = search_frame(decoder, plane, lens)
    if search.found is not None and keep_law and search.law not in (None, decoder.optics.law):
        own = search_frame(decoder, plane, lens, other_laws=False)
        if own.found is None:
            other = finding(Code.CARRIERS_OTHER_LAW, FRAME, law=decoder.optics.law, seen=search.law)
            return LawCheck(decoder, search, other.with_facts(**search.log10_odds))
        search = own
    if search.found is not None:
        return LawCheck(at_found(decoder, search), search)
    if search.expected:
        return LawCheck(decoder, search, search.unseen)
    return LawCheck(decoder, search, None, search.unseen if lens.f_number is None else None)


def search_frame(decoder: MaskDecoder, plane: Source, lens: FrameLens, *, other_laws: bool = True) -> LawSearch:
    """Search a frame for its mask's carriers near the prediction of every law, or only of the decoder's."""
    return search_laws(
        _spectrum(decoder, plane),
        decoder.optics,
        focal_length_mm=lens.focal_length_mm,
        f_number=lens.f_number,
        other_laws=other_laws,
        narrowest_f=lens.narrowest_f,
    )


def at_found(decoder: MaskDecoder, search: LawSearch) -> MaskDecoder:
    """Return the decoder for the frame that a search found the lattice of, by the law that it obeys."""
    assert search.found is not None
    return replace(decoder, optics=decoder.optics.by(search.law or decoder.optics.law), at=search.found.lattice)


def _missing(decoder: MaskDecoder, plane: Source, focal_length_mm: float, f_number: float) -> Finding | None:
    """Why a calibration can't be this frame's; None where it may be."""
    return missing(
        _spectrum(decoder, plane),
        decoder.lattice_at(focal_length_mm),
        decoder.optics,
        f_number,
    )


def _foreign(
    decoder: MaskDecoder,
    plane: Source,
    used: Lattice,
    pairs: Sequence[tuple[Carrier, Measured | None]],
    lens: FrameLens,
) -> Finding | None:
    """Why the carriers that a frame shows can't be those of this mask; None where they may be."""
    seen = tuple((c, m) for c, m in pairs if m is not None and not m.suspect and (c.ky, c.kx) != (0, 0))
    if not seen:
        return None
    return not_this_mask(
        _spectrum(decoder, plane),
        MaskLattice(used, seen, 0.0, math.nan, math.nan),
        decoder.optics,
        f_number=lens.f_number,
    )


def _alike(one: Lattice, other: Lattice) -> bool:
    """Whether two lattices are one within a few percent."""
    change = one.matrix() @ np.linalg.inv(other.matrix())
    return bool(np.abs(change - np.eye(2)).max() < 0.01)


def _spectrum(decoder: MaskDecoder, plane: Source) -> Spectrum:
    return transform(plane, workers=decoder.workers)
