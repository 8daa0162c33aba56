"""A Lytro-like raw, hexagonal and Bayer, in a PNG that says nothing about itself, against its truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from dappled.decode.lenslets import MOSAIC_ROLLOFF, LensletDecoder
from dappled.decode.lightfield.aperture import at_corner
from dappled.decode.lightfield.light_field import LightField
from dappled.decode.lightfield.views import from_lenslet_slices
from dappled.decode.optics.carriers import Carrier
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from tests.simulated.lytro import container, metadata

LFTOOLBOX_DB = (41.9, 42.4, 42.8, 42.9, 43.2, 41.8, 39.4)
PITCH_PX = 5  # of the truth
BORDER = 15


def _recipe(folder: Path, *, colour: bool = False) -> Recipe:
    white = str(folder / "white.png")
    return Recipe("auto", "lenslet", white=white, cfa="BGGR", black=168, white_level=4095, workers=2, colour=colour)


@pytest.mark.slow
def test_views_beat_lftoolbox_s_at_every_offset(shared_data: Path) -> None:
    folder = shared_data / "lenslet/lytro_like"
    truth = np.load(folder / "truth.npz")
    offsets = truth["offsets"][:7, ::-1].astype(float)[None]  # (x, y) in the file
    darkroom = Darkroom(_recipe(folder))
    frame = darkroom.decode(folder / "raw.png", views=False).light_field
    white = darkroom.decode(folder / "white.png", views=False).light_field
    (decoder,) = darkroom._decoders.values()
    assert isinstance(decoder, LensletDecoder)
    assert decoder.white is not None
    origin = at_corner(decoder.white.origin, decoder.white.found.lattice, decoder.shape)

    def views(field: LightField) -> NDArray[np.float32]:
        carriers = [Carrier(int(ky), int(kx), fy, fx) for ky, kx, fy, fx in field.carriers]
        return np.asarray(from_lenslet_slices(field.slices, carriers, origin, offsets, MOSAIC_ROLLOFF)[0])

    found = 0.8 * views(frame) / views(white)
    y, x = np.mgrid[0 : found.shape[1], 0 : found.shape[2]]
    at = np.array([frame.grid[0, 0] * y, frame.grid[1, 1] * x]) / PITCH_PX
    reached = []
    for view, wanted in zip(found, truth["views"], strict=False):
        expected = ndimage.map_coordinates(wanted / 65535, at, order=3, mode="nearest")
        error = (view - expected)[BORDER:-BORDER, BORDER:-BORDER]
        reached.append(float(-10 * np.log10(np.mean(error**2))))
    assert all(ours > theirs + 0.3 for ours, theirs in zip(reached, LFTOOLBOX_DB, strict=True)), reached


@pytest.mark.long
def test_colour_views_have_the_grey_views_as_their_mean(shared_data: Path) -> None:
    folder = shared_data / "lenslet/lytro_like"
    coloured = Darkroom(_recipe(folder, colour=True)).decode(folder / "raw.png").light_field.views
    assert coloured.shape[:2] == (9, 9)
    assert coloured.shape[4] == 3
    grey = Darkroom(_recipe(folder)).decode(folder / "raw.png").light_field.views
    np.testing.assert_allclose(coloured[4, 4].mean(axis=-1), grey[4, 4], atol=2e-3)
    assert np.std(coloured[4, 4] - coloured[4, 4].mean(axis=-1, keepdims=True)) > 0.01


def test_a_colour_pattern_that_is_none_is_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "frame.npy", np.random.default_rng(0).random((64, 64)).astype(np.float32))
    with pytest.raises(DappledError, match="as in BGGR"):
        Darkroom(Recipe("auto", "lenslet", cfa="RGGX")).decode(tmp_path / "frame.npy")


@pytest.mark.long
def test_a_lytro_container_gives_the_same_light_field_as_its_pixels_in_a_png(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "lenslet/lytro_like"
    for name in ("raw", "white"):
        values = np.asarray(Image.open(folder / f"{name}.png")).astype(np.uint16)
        told = metadata((values.shape[0], values.shape[1]), pattern="bggr")
        (tmp_path / f"{name}.lfp").write_bytes(container(values, told))
    plain = Darkroom(_recipe(folder)).decode(folder / "raw.png", views=False).light_field
    packed = Darkroom(Recipe("auto", "lenslet", white=str(tmp_path / "white.lfp"), workers=2))
    found = packed.decode(tmp_path / "raw.lfp", views=False).light_field
    assert found.attributes["camera"] == "F01"
    assert found.slices.tobytes() == plain.slices.tobytes()
