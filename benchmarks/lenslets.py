"""Which roll-off suits lenslet frames with a colour mosaic, on frames with truth: python benchmarks/lenslets.py

Scenes of `depth_scenes.py`, each surface of a colour of its own, seen through hexagonal lenslets 10 px apart behind a
Bayer pattern, with noise; and a white frame. The light at an offset under a lenslet is what the lenslet's middle sees
from that direction, interpolated between whole pixels of offset. PSNR in dB of the grey views at seven offsets, 1.0 =
the white frame's light, by roll-off; the smallest and the mean of the offsets.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
from depth_scenes import FAMILIES, RAYS, Floats, Scene, seen
from limits import show
from numpy.typing import NDArray
from scipy import fft, ndimage, spatial

from dappled.decode.lenslets import LensletDecoder
from dappled.decode.lightfield.aperture import at_corner
from dappled.decode.lightfield.light_field import LightField
from dappled.decode.lightfield.views import from_lenslet_slices
from dappled.decode.optics import Carrier
from dappled.decode.spectrum import plane as planes

PITCH_PX, TURN = 10.0, 0.0017
SIDE, SCENE_PX = 1200, 5  # of the frame; frame pixels a side of a scene's pixel
REACH = 5  # px of offset under a lenslet that are rendered
PER_PX = 0.15  # steps of a scene's views a pixel of offset
LIGHT = 0.8  # of the white frame
FULL_WELL_E, BLACK, WHITE = 20_000.0, 168, 4095
CFA = np.array([[0, 1], [1, 2]])
GAINS = (0.55, 1.0, 0.7)  # of the colours before white balance
OFFSETS = np.array([(0, 0), (0, 2), (0, -2), (2, 0), (2, 2), (0, 3), (0, 4)], dtype=np.float64)  # (y, x), px
ROLLOFFS = (0.2, 0.225, 0.25, 0.275, 0.3, 0.325, 0.35, 0.4)
BORDER = 8  # samples of a view


@dataclass(frozen=True, eq=False)
class LensletFrame:
    """Mosaics `raw` and `white` (H, W), and the true grey `views` (7, h, w) at `OFFSETS` on the scene's pixels."""

    raw: NDArray[np.uint16]
    white: NDArray[np.uint16]
    views: Floats


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=2, help="scenes of each family (default: 2)")
    parser.add_argument("--first", type=int, default=1, help="the first seed (default: 1)")
    parser.add_argument("--json", action="store_true", help="figures as JSON")
    arguments = parser.parse_args()
    found = {}
    for name, family in FAMILIES.items():
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            reached = by_rolloff(exposed(family(seed, SIDE // SCENE_PX), seed))
            found[f"{name}_{seed}"] = {
                f"{kind}_{rolloff:g}": float(of(line))
                for kind, of in (("mean_db", np.mean), ("least_db", np.min))
                for rolloff, line in zip(ROLLOFFS, reached, strict=True)
            }
    show("lenslets", found, as_json=arguments.json)


def exposed(scene: Scene, seed: int) -> LensletFrame:
    """A frame of a scene whose surfaces have colours that the seed draws."""
    chance = np.random.default_rng([seed, 83])
    tints = chance.uniform(0.5, 1.5, (len(scene.surfaces), 3))
    tints /= tints.mean(axis=1, keepdims=True)
    coloured = [
        replace(scene, surfaces=tuple(replace(s, mean=s.mean * t) for s, t in zip(scene.surfaces, tint, strict=True)))
        for tint in tints.T
    ]
    steps = range(-REACH, REACH + 1)
    views = np.array([[[_view(one, dy, dx) for dx in steps] for dy in steps] for one in coloured], dtype=np.float32)
    centres, offsets, lens = _lenslets()
    places = (centres / SCENE_PX - 0.5 + 0.5 / SCENE_PX).T
    at_lens = np.array(
        [
            [[ndimage.map_coordinates(v, places, order=3, mode="nearest") for v in line] for line in colour]
            for colour in views
        ]
    )  # (3, v, u, lenslets)
    index = planes.colour_index((SIDE, SIDE), CFA)
    light = np.zeros((SIDE, SIDE), dtype=np.float32)
    low = np.clip(np.floor(offsets).astype(int), -REACH, REACH - 1)
    part = np.clip(offsets - low, 0, 1)
    for dy in (0, 1):
        for dx in (0, 1):
            weight = np.abs(1 - dy - part[..., 0]) * np.abs(1 - dx - part[..., 1])
            light += weight * at_lens[index, low[..., 0] + REACH + dy, low[..., 1] + REACH + dx, lens]
    through = 0.15 + 0.85 / (1 + np.exp((np.hypot(*np.moveaxis(offsets, -1, 0)) - 4.6) / 0.25))
    through *= np.choose(index, GAINS)
    grey = views.mean(axis=0)
    truth = np.array([grey[round(y) + REACH, round(x) + REACH] for y, x in OFFSETS])
    return LensletFrame(_mosaic(light * through, chance), _mosaic(LIGHT * through, chance), truth)


def _view(scene: Scene, dy: int, dx: int) -> Floats:
    """(h, w) a colour's view at an offset, without what lenslets can't sample."""
    side = SIDE // SCENE_PX
    light, _ = seen(scene, side, dy * PER_PX, dx * PER_PX)
    view = light.reshape(side, RAYS, side, RAYS).mean(axis=(1, 3))
    f = np.hypot(fft.fftfreq(side)[:, None], fft.rfftfreq(side))
    band = 0.5 * SCENE_PX / PITCH_PX
    return np.asarray(fft.irfft2(fft.rfft2(view) * (0.5 - 0.5 * np.tanh((f / band - 0.9) / 0.05)), s=view.shape))


def _lenslets() -> tuple[Floats, Floats, NDArray[np.intp]]:
    """(centres (n, 2), each pixel's offset (H, W, 2) from the nearest one, and its number (H, W))."""
    count = round(SIDE / PITCH_PX) + 6
    rows, columns = np.mgrid[-count:count, -count:count]
    plain = np.stack([rows * PITCH_PX * np.sqrt(3) / 2, (columns + 0.5 * (rows % 2)) * PITCH_PX], axis=-1).reshape(
        -1, 2
    )
    c, s = np.cos(TURN), np.sin(TURN)
    centres = plain @ np.array([[c, s], [-s, c]]) + SIDE / 2 + np.array([0.3, -0.2])
    centres = centres[((centres > -PITCH_PX) & (centres < SIDE + PITCH_PX)).all(axis=1)]
    pixels = np.moveaxis(np.mgrid[0:SIDE, 0:SIDE], 0, -1).astype(np.float64)
    lens = spatial.cKDTree(centres).query(pixels)[1]
    return centres, pixels - centres[lens], lens


def _mosaic(light: Floats, chance: np.random.Generator) -> NDArray[np.uint16]:
    electrons = chance.poisson(np.clip(light, 0, None) * FULL_WELL_E) + chance.normal(0, 6, light.shape)
    counts: Floats = np.rint(BLACK + electrons / FULL_WELL_E * (WHITE - BLACK))
    return counts.clip(0, WHITE).astype(np.uint16)


def by_rolloff(frame: LensletFrame) -> Floats:
    """(rolloffs, offsets) PSNR of the grey views in dB."""
    balance = planes.estimate_balance(frame.white, black=BLACK, cfa=CFA)
    even = [
        planes.to_plane(mosaic, black=BLACK, white=WHITE, cfa=CFA, balance=balance)
        for mosaic in (frame.raw, frame.white)
    ]
    decoder = LensletDecoder.with_white(even[1])
    assert decoder.white is not None
    origin = at_corner(decoder.white.origin, decoder.white.found.lattice, decoder.shape)
    fields = [decoder.decode_reported(plane, views=False)[0] for plane in even]
    y, x = np.mgrid[0 : fields[0].slices.shape[1], 0 : fields[0].slices.shape[2]]
    grid = fields[0].grid
    at = np.array([grid[0, 0] * y + grid[0, 2], grid[1, 1] * x + grid[1, 2]]) / SCENE_PX - 0.5 + 0.5 / SCENE_PX
    wanted = np.array([ndimage.map_coordinates(one, at, order=3, mode="nearest") for one in frame.views])
    inside = (..., slice(BORDER, -BORDER), slice(BORDER, -BORDER))
    found = []
    for rolloff in ROLLOFFS:
        scene, white = (_views(field, origin, rolloff) for field in fields)
        error = (LIGHT * scene / white - wanted)[inside]
        found.append(-10 * np.log10(np.mean(error**2, axis=(1, 2))))
    return np.array(found, dtype=np.float32)


def _views(field: LightField, origin: tuple[float, float], rolloff: float) -> Floats:
    carriers = [Carrier(int(ky), int(kx), fy, fx) for ky, kx, fy, fx in field.carriers]
    return np.asarray(from_lenslet_slices(field.slices, carriers, origin, OFFSETS[None], rolloff)[0])


if __name__ == "__main__":
    main()
