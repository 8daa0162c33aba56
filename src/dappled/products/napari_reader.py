"""Read light fields into napari: the reader that the manifest `napari.json` names, by the contract of npe2.

napari itself is not needed here: layers are tuples of array, options and the word "image".
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from dappled.products.extras import MissingExtraError, need
from dappled.products.opened import OpenedLightField, light_field

_Layer: TypeAlias = tuple[Any, dict[str, Any], str]
_ARRAYS = ("views", "carriers")  # both are in every light field, and in few files of others
_WHITE = 0.995  # quantile that is shown as white


def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[_Layer]] | None:
    """Return the reader for these paths, or None where one of them is no light field; nothing is loaded yet."""
    return read if all(_may_be(Path(one)) for one in _each(path)) else None


def read(path: str | Sequence[str]) -> list[_Layer]:
    """Return the layers of these light fields: views (v, u, y, x), and the slices' magnitudes, hidden behind views.

    Raises DappledError for what can't be read.
    """
    return [layer for one in _each(path) for layer in _layers(light_field(one), Path(one).stem)]


def _layers(found: OpenedLightField, name: str) -> list[_Layer]:
    about = {"metadata": dict(found.attributes)}
    layers: list[_Layer] = []
    if found.views.size:
        top = max(float(np.nanquantile(found.views, _WHITE)), 1e-9)
        if found.views.ndim == 5:  # napari takes colours from 0 to 1 and clips them
            layers.append((np.clip(found.views / top, 0, 1), {"name": f"{name} views", "rgb": True, **about}, "image"))
        else:
            options = {"name": f"{name} views", "rgb": False, "contrast_limits": (0.0, top)}
            layers.append((found.views, {**options, **about}, "image"))
    if found.slices.size:
        size = np.abs(found.slices)
        white = np.maximum(np.quantile(size, _WHITE, axis=(1, 2), keepdims=True), 1e-12).astype(np.float32)
        options = {
            "name": f"{name} slices, each by its own white",
            "visible": not layers,
            "contrast_limits": (0.0, 1.0),
        }
        layers.append((size / white, {**options, **about}, "image"))
    return layers


def _may_be(path: Path) -> bool:
    """Whether a path looks like a light field of ours: other programs write .zarr, .npz and .h5 too."""
    if path.suffix == ".zarr":
        return all((path / name / "zarr.json").is_file() for name in _ARRAYS)
    try:
        if path.suffix == ".npz":
            with zipfile.ZipFile(path) as file:
                return {f"{name}.npy" for name in _ARRAYS} <= set(file.namelist())
        if path.suffix == ".h5":
            with need("h5py").File(path, "r") as file:
                return set(_ARRAYS) <= set(file)
    except (zipfile.BadZipFile, OSError, ValueError, MissingExtraError):
        return False
    return False


def _each(path: str | Sequence[str]) -> Sequence[str]:
    return [path] if isinstance(path, str) else path
