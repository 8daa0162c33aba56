"""Views of the joint model that is told the true disparities: what is left to gain by finding them better.

As `dappled.decode.joint.joint_views` has it, each patch of the slices is a sum of the band's own detail at some
disparities, of detail that folds in, of what views have alone, and of noise. Here each patch is told which share of it
lies at which disparity. The strength of its texture, and how much detail there is beyond the band, are the most
probable ones of a few.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dappled.decode.joint.patch_model import SIDE, FrameModel, PatchKind, TexturePower, rests_of
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.slice_model import SliceModel
from dappled.decode.joint.view_pairs import paired, views_of
from dappled.decode.lightfield.aperture import Aperture
from dappled.decode.lightfield.light_field import LightField

Floats = NDArray[np.float64]
STRENGTHS = (0.1, 0.3, 1.0, 3.0, 10.0)
KINDS = [PatchKind(1, beyond, 0.01) for beyond in (0.0, 0.1, 1.0, 4.0, 16.0, 64.0)]
GROUPS = 3  # of patches of similar texture, which share a spectrum
TRIED = 5  # of so many frequencies one is looked at to choose strength and kind
LEAST_SHARE = 0.02  # of a patch: less is left out


def views_given(field: LightField, disparity: NDArray[np.floating]) -> NDArray[np.float32]:
    """The views (V, U, h, w) of a light field's slices, told the `disparity` (H, W) of each pixel of the frame, in
    sensor columns over the aperture."""
    patches = Patches((field.slices.shape[1], field.slices.shape[2]), SIDE)
    frame, used = _model(field, patches)
    slices = field.slices[used]
    cut, means = patches.less_means(patches.cut(slices), frame.model.common()[: len(slices)])
    spectra = patches.spectra(cut)
    texture = np.log(np.abs(spectra[:, 0]) ** 2 + 1e-12).mean(axis=0)
    group = np.searchsorted(np.quantile(texture, np.arange(1, GROUPS) / GROUPS), texture)
    count = frame.model.aperture.views
    made = np.zeros((len(spectra), count**2, len(means)), dtype=np.complex64)
    for number in range(GROUPS):
        alike = np.flatnonzero(group == number)
        power = np.maximum((np.abs(spectra[:, 0, alike]) ** 2).mean(axis=1) - frame.noise[0], 0)
        spectrum = TexturePower.of(power, frame.radius(frame.frequencies))
        own = spectrum.at(frame.radius(frame.frequencies))
        made_of = rests_of(frame, spectrum, own, float(np.sqrt(np.mean(means[alike] ** 2))), KINDS)
        rests = [made_of.of(number) for number in range(len(KINDS))]
        for one in alike:
            there = _disparities(disparity, field.grid, patches, int(one))
            made[:, :, one] = _views(frame, own, rests, spectra[:, :, one], there)
    windowed = patches.images(views_of(made)) + (means[:, None, None] * patches.window).astype(np.float32)[:, None]
    return patches.joined(windowed).reshape(count, count, *slices.shape[1:])


def _model(field: LightField, patches: Patches) -> tuple[FrameModel, NDArray[np.intp]]:
    """What all patches share, and which slices are used."""
    facts = field.attributes
    down, across, real, imaginary = np.array(facts["transfers"]).T
    transfers = real + 1j * imaginary
    used = np.flatnonzero(transfers)
    orders = [(int(ky), int(kx)) for ky, kx in field.carriers[used, :2]]
    aperture = Aperture(field.views.shape[0], facts["aperture"])
    angular = np.stack([down, across], axis=1)[used]
    model = SliceModel.of_half(orders, transfers[used], angular, field.carriers[used, 2:], aperture)
    share = np.prod(facts["band"]) / np.prod(facts["padded"])
    noise = np.full(2 * len(used) - 1, facts["noise_rms"] ** 2 * share)
    steps = float(field.grid[0, 0]), float(field.grid[1, 1])
    return FrameModel.of(patches, model, steps, noise, reach=aperture.views * steps[1]), used


def _disparities(disparity: NDArray[np.floating], grid: Floats, patches: Patches, number: int) -> tuple[Floats, Floats]:
    """The disparities that occur in a patch, and their shares of it, less at its edges."""
    pixels, corner = [], patches.corners[number]
    for begin, (step, first), side in zip(corner, (grid[0, [0, 2]], grid[1, [1, 2]]), disparity.shape, strict=True):
        samples = begin - SIDE + np.arange(SIDE)
        pixels.append(np.clip(np.rint(samples * step + first), 0, side - 1).astype(int))
    there, at = np.unique(disparity[np.ix_(*pixels)].astype(np.float64), return_inverse=True)
    sums = np.bincount(at.ravel(), weights=(patches.window**2).ravel())
    shares = np.asarray(sums / sums.sum())
    kept = shares >= LEAST_SHARE
    return there[kept], shares[kept] / shares[kept].sum()


def _views(
    frame: FrameModel,
    own: Floats,
    rests: list[NDArray[np.complex64]],
    spectra: NDArray[np.complex64],
    there: tuple[Floats, Floats],
) -> NDArray[np.complex64]:
    """The spectra (F, V·U) of a patch's views, in pairs."""
    disparities, shares = there
    size = np.sqrt(own[:, None, None] * shares[:, None])
    seen = frame.model.seen(frame.frequencies, disparities).transpose(1, 0, 2) * size
    viewed = paired(frame.model.viewed(frame.frequencies, disparities)).transpose(1, 0, 2) * size
    detail = seen.transpose(0, 2, 1) @ seen.conj()
    shared = viewed.transpose(0, 2, 1) @ seen.conj()
    some = slice(None, None, TRIED)
    nats = {}
    for number, rest in enumerate(rests):
        for strength in STRENGTHS:
            whole = strength * detail[some] + rest[some]
            left = np.sum(spectra[some].conj() * np.linalg.solve(whole, spectra[some, :, None])[..., 0], axis=1).real
            nats[number, strength] = -float(frame.weights[some] @ (np.linalg.slogdet(whole)[1] + left))
    number, strength = max(nats, key=nats.__getitem__)
    alone = KINDS[number].alone * own[:, None, None] * frame.alone.conj().T
    solved = np.linalg.solve(strength * detail + rests[number], spectra[..., None])
    return np.asarray(((strength * shared + alone) @ solved)[..., 0], dtype=np.complex64)
