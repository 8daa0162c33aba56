"""Save and load light fields: a Zarr v3 group, .npz or .h5, with the arrays of `LightField` under their names.

`docs/lightfield.md` has every array, axis, unit and attribute. In Zarr and HDF5 the axes have names, and the arrays
have units. The attributes are the group's attributes in Zarr, and the JSON text of the array `attributes` in .npz. In
HDF5 they are the file's attributes (those without an HDF5 type as JSON text), and all of them as JSON text in
`attributes`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dappled import codec, confined
from dappled.bounds.arrays import read_npz
from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import parse_json
from dappled.decode.lightfield import LightField
from dappled.errors import DappledError, first_line
from dappled.findings import Finding
from dappled.products.exports import h5_reader, packed_arrays
from dappled.products.extras import need
from dappled.products.whole_files import whole

_ARRAYS: dict[str, tuple[type[np.generic], int]] = {
    "slices": (np.complex64, 3),
    "carriers": (np.float64, 2),
    "views": (np.float32, 4),
    "view_offsets": (np.float64, 3),
    "grid": (np.float64, 2),
}
_ADDED: dict[str, tuple[type[np.generic], int]] = {"view_sigma": (np.float32, 4)}  # may be missing
_UNITS = {
    "slices": "1",
    "carriers": "cycles/pixel",
    "views": "1",
    "view_offsets": "1",
    "grid": "pixel",
    "view_sigma": "1",
}
_ATTRIBUTES = "attributes"
_NUMBERS = ("focal_length_mm", "f_number", "lenslet_pitch_px", "noise_rms")
_WORDS = ("camera", "mask", "law", "aperture")


def save(path: Path, field: LightField, *, overwrite: bool = False) -> None:
    """Write a light field as .zarr, .npz or .h5, by the extension; whole and durable under its name, or not at all.

    Raises DappledError, also when the file exists and `overwrite` is false.
    """
    write = _of(path, {".zarr": _save_zarr, ".npz": _save_npz, ".h5": _save_h5})
    arrays: _Arrays = {
        name: np.asarray(getattr(field, name), dtype=kind)
        for name, (kind, _) in {**_ARRAYS, **_ADDED}.items()
        if name in _ARRAYS or getattr(field, name) is not None
    }
    _fits(path, arrays)
    attributes = _json(path, field.attributes)
    if path.exists() and not overwrite:
        raise DappledError(f"{path} exists already: choose another name, or --overwrite replaces it (overwrite=True)")
    with whole(path) as part:
        write(part, arrays, attributes)


def load(path: Path) -> LightField:
    """Read a light field that `save` wrote. What it claims is judged first: a damaged or hostile file takes no memory.

    Raises DappledError.
    """
    read = _of(path, {".zarr": _load_zarr, ".npz": _load_npz, ".h5": _load_h5})
    if not path.exists():
        raise DappledError(f"there is no light field {path}; check the path")
    try:
        arrays, attributes = read(path)
    except DappledError:
        raise
    except ClaimError as error:
        raise DappledError(f"{path}: {error}") from error
    except KeyError as error:
        raise DappledError(f"{path} is not a light field: it lacks {error}") from error
    except MemoryError as error:
        raise DappledError(f"{path} needs more memory than is free: close other programs") from error
    except Exception as error:  # the readers raise anything on damaged bytes
        raise DappledError(f"{path} is not a light field, or is damaged: {first_line(error)}") from error
    _check_attributes(path, attributes)
    _fits(path, arrays)
    for name, (kind, _) in {**_ARRAYS, **_ADDED}.items():
        if name in arrays and arrays[name].dtype != kind:
            raise DappledError(f"{path} is not a light field: {name} is {arrays[name].dtype}, not {np.dtype(kind)}")
    return LightField(**arrays, attributes=attributes)


_Arrays = dict[str, NDArray[Any]]


def axes(arrays: Mapping[str, NDArray[Any]]) -> dict[str, tuple[str, ...]]:
    """The names of each array's axes. Slices share y and x with the views where both have the same size."""
    views = arrays["views"].shape
    own = "" if arrays["slices"].shape[1:] == views[2:4] else "slice_"
    return {
        "slices": ("slice", f"{own}y", f"{own}x"),
        "carriers": ("slice", "carrier"),
        "views": ("v", "u", "y", "x", "channel")[: len(views)],
        "view_offsets": ("v", "u", "direction"),
        "grid": ("direction", "term"),
        "view_sigma": ("v", "u", "patch_y", "patch_x"),
    }


def _of(path: Path, kinds: Mapping[str, Callable[..., Any]]) -> Callable[..., Any]:
    if path.suffix not in kinds:
        raise DappledError(
            f"{path}: a light field's file ends in .zarr, .npz or .h5, not in {path.suffix or 'nothing'}"
        )
    return kinds[path.suffix]


def _fits(path: Path, arrays: _Arrays) -> None:
    """Check that the arrays' shapes agree with each other, as `LightField` has them. Raises DappledError."""
    for name, (_, dimensions) in {**_ARRAYS, **_ADDED}.items():
        if name in arrays and arrays[name].ndim != dimensions and not (name == "views" and arrays[name].ndim == 5):
            raise DappledError(f"{path}: {name} has {arrays[name].ndim} dimensions, a light field has {dimensions}")
    slices, views = arrays["slices"].shape, arrays["views"].shape
    expected = {"carriers": (slices[0], 4), "view_offsets": (*views[:2], 2), "grid": (2, 3)}
    if "view_sigma" in arrays:
        expected["view_sigma"] = (*views[:2], *arrays["view_sigma"].shape[2:])
    for name, shape in expected.items():
        if arrays[name].shape != shape:
            raise DappledError(f"{path}: {name} has the shape {arrays[name].shape}, beside the others it needs {shape}")


def _check_attributes(path: Path, attributes: Any) -> None:
    """Check what readers calculate with: numbers, words and the frame's shape. Raises DappledError."""
    if not isinstance(attributes, dict):
        raise DappledError(f"{path} is not a light field: its attributes are not a JSON object")
    kinds: dict[str, tuple[type, ...]] = {**dict.fromkeys(_NUMBERS, (int, float)), **dict.fromkeys(_WORDS, (str,))}
    for name, kind in kinds.items():
        value = attributes.get(name)
        if value is not None and (not isinstance(value, kind) or isinstance(value, bool)):
            what = "a text" if kind == (str,) else "a number"
            raise DappledError(f"{path}: its attribute {name} is not {what}; decode the frame again")
    try:
        codec.read(tuple[Finding, ...], attributes.get("doubts") or [])
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise DappledError(f"{path}: its attribute doubts is not a list of findings; decode it again") from error
    shape = attributes.get("shape", [1, 1])
    if not (isinstance(shape, list) and len(shape) == 2 and all(type(side) is int and side > 0 for side in shape)):
        raise DappledError(f"{path}: its attribute shape is not rows and columns; decode the frame again")


def _json(path: Path, attributes: Mapping[str, Any]) -> dict[str, Any]:
    def plain(value: object) -> Any:
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        if isinstance(value, os.PathLike):
            return str(value)
        raise TypeError(f"{type(value).__name__} is not JSON")

    try:
        text = json.dumps(dict(attributes), default=plain, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise DappledError(
            f"cannot write the light field {path}: its attributes don't fit into JSON ({error})"
        ) from error
    value: dict[str, Any] = json.loads(text)
    return value


def _save_zarr(part: Path, arrays: _Arrays, attributes: dict[str, Any]) -> None:
    group = need("zarr", "use .npz").open_group(store=part, mode="w-", zarr_format=3, attributes=attributes)
    names = axes(arrays)
    for name, values in arrays.items():
        # One chunk for each slice or view: they are read one at a time.
        lead = {"slices": 1, "views": 2}.get(name, 0)
        chunks = tuple(max(1, side) for side in ((1,) * lead + values.shape[lead:]))
        group.create_array(
            name,
            shape=values.shape,
            dtype=values.dtype,
            chunks=chunks,
            dimension_names=names[name],
            attributes={"units": _UNITS[name]},
        )[...] = values


def _load_zarr(path: Path) -> tuple[_Arrays, dict[str, Any]]:
    zarr = need("zarr", "use .npz")
    confined.refuse_links(path, f"the light field {path}")
    added = {name: kind for name, kind in _ADDED.items() if (path / name).is_dir()}
    kinds = {name: kind for name, (kind, _) in {**_ARRAYS, **added}.items()}
    attributes = packed_arrays.zarr_attributes(path, kinds)
    # Without consolidated metadata: it would replace what was judged.
    group = zarr.open_group(store=path, mode="r", zarr_format=3, use_consolidated=False)
    return {name: np.asarray(group[name][...]) for name in kinds}, attributes


def _save_npz(part: Path, arrays: _Arrays, attributes: dict[str, Any]) -> None:
    with part.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays, **{_ATTRIBUTES: np.array(json.dumps(attributes))})


def _load_npz(path: Path) -> tuple[_Arrays, dict[str, Any]]:
    found = read_npz(path, [*_ARRAYS, _ATTRIBUTES], also=_ADDED)
    return found, parse_json(str(found.pop(_ATTRIBUTES)))


def _save_h5(part: Path, arrays: _Arrays, attributes: dict[str, Any]) -> None:
    with need("h5py", "use .npz").File(part, "w") as file:
        names = axes(arrays)
        for name, values in arrays.items():
            made = file.create_dataset(name, data=values)
            made.attrs["units"] = _UNITS[name]
            for axis, label in zip(made.dims, names[name], strict=True):
                axis.label = label
        for key, value in attributes.items():
            file.attrs[key] = value if isinstance(value, str | int | float | bool) else json.dumps(value)
        file.attrs[_ATTRIBUTES] = json.dumps(attributes)


def _load_h5(path: Path) -> tuple[_Arrays, dict[str, Any]]:
    need("h5py", "use .npz")
    arrays, attributes = h5_reader.read(path, list(_ARRAYS), _ATTRIBUTES, also=list(_ADDED))
    return arrays, parse_json(attributes)
