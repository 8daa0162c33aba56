"""Snow before a scene, for docs/products.md: python tools/volume_picture.py frame.zarr docs/pictures/products

Adds flakes of another disparity, and noise, to the views of a decoded frame, and draws side by side: the middle view,
the picture refocused on a plane, and a volume in focus. Look at volume.webp before you commit it.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from dappled.decode.lightfield import ViewStack
from dappled.decode.lightfield.refocus import shift_and_add
from dappled.decode.lightfield.volume_filter import within
from dappled.products.exports import light_files, prints

NEAREST, FARTHEST, SNOW = -0.3, 0.3, 2.2  # px from view to view
FLAKES, NOISE, GAP_PX = 260, 0.04, 6  # noise as a share of white


def main(source: Path, folder: Path) -> None:
    stack = ViewStack.of(light_files.load(source))
    chance = np.random.default_rng(48)
    height, width = stack.views.shape[2:4]
    white = float(np.quantile(stack.views, 0.995))
    flakes = np.zeros((height, width))
    flakes[chance.integers(0, height, FLAKES), chance.integers(0, width, FLAKES)] = chance.uniform(0.4, 1.0, FLAKES)
    flakes = ndimage.gaussian_filter(flakes, 1.1)
    flakes *= 1.4 * white / flakes.max()
    views = stack.views + chance.normal(0, NOISE * white, stack.views.shape).astype(np.float32)
    for v, row in enumerate(stack.row_steps):
        for u, column in enumerate(stack.column_steps):
            seen = ndimage.shift(flakes, (SNOW * row, SNOW * column), order=3, mode="grid-wrap")
            views[v, u] += seen[..., None] if stack.colour else seen
    snowy = replace(stack, views=np.clip(views, 0, None).astype(np.float32))
    plane = shift_and_add(snowy, (NEAREST + FARTHEST) / 2)
    drawn = [prints.toned(one, white) for one in (snowy.middle(), plane, within(snowy, NEAREST, FARTHEST))]
    gap = np.full((height, GAP_PX, *drawn[0].shape[2:]), 255, np.uint8)
    sheet = np.concatenate([drawn[0], gap, drawn[1], gap, drawn[2]], axis=1)
    Image.fromarray(sheet).save(folder / "volume.webp", quality=82, method=6)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(Path(sys.argv[1]), Path(sys.argv[2]))
