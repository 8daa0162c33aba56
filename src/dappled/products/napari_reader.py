"""Read light fields into napari: the reader that the manifest `napari.json` names, by the contract of npe2.

napari itself is not needed here: layers are tuples of array, options and the word "image".
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from dappled.products.opened import OpenedLightField, light_field

_Layer: TypeAlias = tuple[Any, dict[str, Any], str]


def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[_Layer]] | None:
    """Return the reader for these paths, or None where one of them is no light field; nothing is loaded yet."""
    return read if all(_may_be(Path(one)) for one in _each(path)) else None


def read(path: str | Sequence[str]) -> list[_Layer]:
    """Return the layers of these light fields: views (v, u, y, x), and the slices' magnitudes, hidden at first.

    Raises DappledError for what can't be read.
    """
    return [layer for one in _each(path) for layer in _layers(light_field(one), Path(one).stem)]


def _layers(found: OpenedLightField, name: str) -> list[_Layer]:
    about = {"metadata": dict(found.attributes)}
    layers: list[_Layer] = []
    if found.views.size:
        options = {"name": f"{name} views", "rgb": found.views.ndim == 5, "axis_labels": ("v", "u", "y", "x")}
        layers.append((found.views, {**options, **about}, "image"))
    if found.slices.size:
        options = {"name": f"{name} slices", "visible": not layers, "axis_labels": ("slice", "y", "x")}
        layers.append((np.abs(found.slices), {**options, **about}, "image"))
    return layers


def _may_be(path: Path) -> bool:
    """Whether a path looks like a light field of ours: other programs write .zarr and .npz too."""
    if path.suffix == ".zarr":
        return (path / "views" / "zarr.json").is_file() and (path / "carriers" / "zarr.json").is_file()
    if path.suffix == ".npz":
        if not zipfile.is_zipfile(path):
            return False
        with zipfile.ZipFile(path) as file:
            return {"views.npy", "carriers.npy"} <= set(file.namelist())
    return path.suffix == ".h5" and path.is_file()


def _each(path: str | Sequence[str]) -> Sequence[str]:
    return [path] if isinstance(path, str) else path
