"""Cut slices into overlapping patches, and put patches of views together again."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from dappled.decode.array_types import Complexes, Floats, Singles
from dappled.workers import spans

_AT_A_TIME = 128  # patches: what is worked on stays small


@dataclass(frozen=True, slots=True)
class Patches:
    """Square patches of `side` samples, half overlapping, over images of `shape`; those at the edges reach beyond it.

    A patch is weighed by half a period of a sine along each axis, before and after.
    """

    shape: tuple[int, int]
    side: int

    @property
    def grid(self) -> tuple[int, int]:
        """How many rows and columns of patches there are."""
        half = self.side // 2
        rows, columns = (len(range(half, side + self.side, half)) for side in self.shape)
        return rows, columns

    @property
    def corners(self) -> list[tuple[int, int]]:
        """Where each patch begins, in an image that is continued by one side at the top and the left."""
        half = self.side // 2
        rows, columns = (range(half, side + self.side, half) for side in self.shape)
        return list(itertools.product(rows, columns))

    @property
    def at_edges(self) -> NDArray[np.bool_]:
        """(N,) which patches reach beyond the images, or to their edges."""
        corners = np.array(self.corners) - self.side
        return np.asarray(((corners <= 0) | (corners + self.side >= np.array(self.shape))).any(axis=1))

    @property
    def window(self) -> Floats:
        """(side, side) the weight of a patch's samples, of unit sum of squares over all overlapping patches."""
        along = np.sin(np.pi * (np.arange(self.side) + 0.5) / self.side)
        return np.outer(along, along)

    @property
    def bins(self) -> Floats:
        """(F, 2) the frequencies of half a plane in cycles/sample, as `fft.rfft2` lists them."""
        down, across = fft.fftfreq(self.side), fft.rfftfreq(self.side)
        return np.stack(np.meshgrid(down, across, indexing="ij"), axis=-1).reshape(-1, 2)

    @property
    def multiplicity(self) -> Floats:
        """(F,) how many of the whole plane's frequencies each of `bins` stands for."""
        columns = self.side // 2 + 1
        at = np.arange(self.side * columns) % columns
        return np.where((at == 0) | (2 * at == self.side), 1.0, 2.0)

    def cut(self, images: NDArray[Any], which: NDArray[np.intp] | None = None) -> NDArray[Any]:
        """(K, N, side, side) the patches of images (K, h, w), continued at their edges by reflection; or `which` (N,)
        of them."""
        n, corners = self.side, np.array(self.corners)
        rows, columns = (np.pad(np.arange(size), (n, 2 * n), mode="symmetric") for size in self.shape)
        top, left = (corners if which is None else corners[which]).T[:, :, None] + np.arange(n)
        places = rows[top][:, :, None] * self.shape[1] + columns[left][:, None, :]
        return np.asarray(images.reshape(len(images), -1).take(places, axis=1))

    def less_means(self, patches: Complexes, common: NDArray[Any]) -> tuple[Complexes, Floats]:
        """The patches (K, N, side, side), in their place, without their means (N,) by the window: those of the first
        image, times what each image holds of what is `common` (K,)."""
        weights = self.window**2
        means = np.einsum("nyx,yx->n", patches[0].real, weights) / weights.sum()
        patches -= (common[:, None] * means).astype(np.complex64)[:, :, None, None]
        return patches, means

    def contrasts(self, image: NDArray[Any], which: NDArray[np.intp]) -> Floats:
        """(N,) by the window, the variances of `which` (N,) patches of an image (h, w)."""
        cut, _ = self.less_means(self.cut(image[None].astype(np.complex64), which), np.ones(1, dtype=np.complex128))
        return np.asarray(np.einsum("nyx,yx->n", cut[0].real ** 2, self.window**2))

    def spectra(self, patches: Complexes) -> Complexes:
        """(F, 2K − 1, N) the spectra of patches (K, N, side, side), of the slices and then of their conjugates but the
        first's, scaled so that white noise keeps its variance."""
        columns = self.side // 2 + 1
        scaled = (self.window * (2 / self.side)).astype(np.float32)
        back = -np.arange(self.side)
        half = np.ix_(back, back[:columns])
        count = len(patches)
        found = np.empty((self.side * columns, 2 * count - 1, patches.shape[1]), dtype=np.complex64)
        for some in spans(patches.shape[1], _AT_A_TIME):
            whole = fft.fft2(patches[:, some] * scaled)
            mirrored = whole[1:, :, half[0], half[1]].conj()
            for at, part in ((slice(count), whole[..., :columns]), (slice(count, None), mirrored)):
                found[:, at, some] = part.reshape(*part.shape[:2], len(found)).transpose(2, 0, 1)
        return found

    def images(self, spectra: Complexes, lit: Singles | None = None) -> Singles:
        """(N, V, side, side) the windowed patches of real images from their half spectra (F, V, N), and what is `lit`
        (N, 1, side, side) in all images."""
        columns, count = self.side // 2 + 1, spectra.shape[1]
        made = np.empty((spectra.shape[2], count, self.side, self.side), dtype=np.float32)
        for some in spans(len(made), _AT_A_TIME):
            whole = np.ascontiguousarray(spectra[:, :, some].transpose(2, 1, 0)).reshape(-1, self.side, columns)
            image = fft.irfft2(whole, s=(self.side, self.side), overwrite_x=True, norm="forward")
            np.multiply(image.reshape(-1, count, self.side, self.side), 0.5 / self.side, out=made[some])
            if lit is not None:
                made[some] += lit[some]
        return made

    def joined(self, patches: Singles) -> Singles:
        """(V, h, w) of windowed patches (N, V, side, side)."""
        n, (height, width) = self.side, self.shape
        total = np.zeros((patches.shape[1], height + 3 * n, width + 3 * n), dtype=np.float32)
        window = self.window.astype(np.float32)
        for (top, left), patch in zip(self.corners, patches, strict=True):
            total[:, top : top + n, left : left + n] += patch * window
        return np.ascontiguousarray(total[:, n : n + height, n : n + width])

    def apart(self, patches: Singles, images: Singles) -> Floats:
        """(V, N) the mean squares by which windowed patches (N, V, side, side) are apart from the images (V, h, w) that
        they and the patches beside them were joined to."""
        n, window = self.side, self.window.astype(np.float32)
        found = np.empty((patches.shape[1], len(patches)))
        for number, corner in enumerate(self.corners):
            begins = [max(0, n - at) for at in corner]  # what of the patch lies within the images
            ends = [min(n, n + size - at) for at, size in zip(corner, self.shape, strict=True)]
            inside = tuple(slice(*bounds) for bounds in zip(begins, ends, strict=True))
            there = tuple(slice(at - n + one.start, at - n + one.stop) for at, one in zip(corner, inside, strict=True))
            off = patches[number][:, *inside] - images[:, *there] * window[inside]
            found[:, number] = np.einsum("vyx,vyx->v", off, off) / (window[inside] ** 2).sum()
        return found
