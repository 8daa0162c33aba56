"""From a raw file's mosaic to the linear plane that is decoded: black, defects, dark and white frame, colours, rows."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled.config import profiles
from dappled.decode.errors import DecodeError
from dappled.decode.latest import Latest
from dappled.decode.spectrum import plane as planes
from dappled.decode.spectrum.colours import local_colours
from dappled.decode.spectrum.defects import Places, find_defects, mended
from dappled.decode.spectrum.developer import Developer, developer
from dappled.decode.spectrum.linear_rows import Exposure
from dappled.decode.spectrum.plane import Plane
from dappled.decode.spectrum.stagger import spread
from dappled.decode.spectrum.transform import Source
from dappled.drivers.raw.reading import RawFile
from dappled.drivers.raw.recipe import Recipe, camera_profile, naming, read, said

_KEPT = 4  # developers: some bodies say another black level with every frame


class FrameLineariser:
    """Makes frames of one recipe linear. What every frame needs (dark and white frame, gains) is made once and kept."""

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        self._dark: NDArray[Any] | None = None
        self._defects: Places | None = None
        self._gains: dict[tuple[int, int], Plane] = {}
        self._balance: NDArray[np.float64] | None = None
        self._developers: Latest[Developer] = Latest(_KEPT)
        self._staggered: dict[tuple[tuple[int, int], str], bool] = {}

    def plane(self, raw: RawFile) -> Plane:
        """The linear plane of a frame: black, white, dark frame; for masks also colours evened out, and white frame."""
        exposure = self.expose(raw, colour=False)[0]
        source = self.where_taken(exposure, raw)
        return source.plane(self._recipe.workers) if isinstance(source, Exposure) else source

    def where_taken(self, exposure: Exposure, raw: RawFile) -> Source:
        """The plane with each sample where it stands on the chip: a staggered one spread out."""
        if self._recipe.mask == profiles.LENSLET:
            return exposure
        key = exposure.shape, raw.camera_model or ""
        if key not in self._staggered:
            self._staggered[key] = camera_profile(self._recipe, key[1]).staggered(key[0])
        return spread(exposure.plane(self._recipe.workers)) if self._staggered[key] else exposure

    def expose(self, raw: RawFile, *, colour: bool) -> tuple[Exposure, NDArray[np.float32] | None]:
        """The plane to be, and local colours (3, rows, columns) as shares of it where they are asked for."""
        raw = said(raw, self._recipe)
        lenslets = self._recipe.mask == profiles.LENSLET
        cfa, black = _one_index_a_colour(raw)
        balance = None if cfa is None or not lenslets else self._white_balance()
        dark = self._dark_frame()
        if dark is not None and dark.shape == raw.mosaic.shape:
            period = (1, 1) if cfa is None else (cfa.shape[0], cfa.shape[1])
            if self._defects is None:
                self._defects = find_defects(dark, period)
                self._dark = dark = mended(dark, self._defects, period)
            raw = replace(raw, mosaic=mended(raw.mosaic, self._defects, period))
        workers = self._recipe.workers
        reference: list[int] = []
        chroma = None
        if cfa is not None:
            names = raw.colour_names
            # Behind lenslets the grey view is the mean of the colours; a masked frame has most of its detail in green.
            reference = [names.index("G")] if "G" in names and not lenslets else sorted({int(c) for c in cfa.flat})
            if colour and all(name in names for name in "RGB"):
                even = planes.to_plane(
                    raw.mosaic, black=black, white=raw.white, cfa=cfa, balance=balance, dark=dark, workers=workers
                )
                chroma = local_colours(even, cfa, [names.index(name) for name in "RGB"], reference)
        elif colour:
            raise DecodeError("the frame has no colour pattern: decode it without --colour, or name it with --cfa")
        planes.check_shape(raw.mosaic)
        shape = raw.mosaic.shape[0], raw.mosaic.shape[1]
        key = shape, None if cfa is None else (cfa.shape, cfa.tobytes()), black, raw.white
        develop = self._developers.of(
            key, lambda: developer(shape, black=black, white=raw.white, cfa=cfa, balance=balance, reference=reference)
        )
        flat = self._gain(shape) if self._recipe.white and not lenslets else None
        return develop.expose(raw.mosaic, dark=dark, flat=flat, workers=workers), chroma

    def _white_balance(self) -> NDArray[np.float64] | None:
        """The gains that make the white frame grey; None without one."""
        if self._recipe.white and self._balance is None:
            raw = read(self._recipe.white, self._recipe)
            cfa, black = _one_index_a_colour(raw)
            if cfa is not None:
                self._balance = planes.estimate_balance(raw.mosaic, black=black, cfa=cfa)
        return self._balance

    def _dark_frame(self) -> NDArray[Any] | None:
        if self._recipe.dark and self._dark is None:
            self._dark = read(self._recipe.dark, self._recipe).mosaic
        return self._dark

    def _gain(self, shape: tuple[int, int]) -> Plane:
        if shape not in self._gains:
            raw = read(self._recipe.white, self._recipe)
            with naming(self._recipe.white):
                cfa, black = _one_index_a_colour(raw)
                white = planes.to_plane(raw.mosaic, black=black, white=raw.white, cfa=cfa)
                self._gains[shape] = planes.white_gain(white, cell_px=math.sqrt(white.size) / 32)
        return self._gains[shape]


def _one_index_a_colour(raw: RawFile) -> tuple[NDArray[np.int64] | None, float | tuple[float, ...]]:
    """The colour pattern and black levels with both greens as one colour, where their black levels agree.

    LibRaw gives a Bayer pattern's second green an index of its own; it is then no longer the commonest colour.
    """
    if raw.cfa is None:
        return None, raw.black
    levels = raw.black if isinstance(raw.black, tuple) else (raw.black,) * len(raw.colour_names)
    first = [raw.colour_names.index(name) for name in raw.colour_names]
    if any(levels[index] != levels[one] for index, one in enumerate(first)):
        return raw.cfa, raw.black
    return np.array(first, dtype=np.int64)[raw.cfa], raw.black
