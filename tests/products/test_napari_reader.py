"""What napari gets: the manifest of the entry point, and the layers that its reader returns."""

from __future__ import annotations

import json
import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import dappled
from dappled.products.exports import light_files
from tests.products.fields import light_field

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def get_reader() -> Any:
    """The function that the entry point's manifest names, found as npe2 finds it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    module, _, name = project["entry-points"]["napari.manifest"]["dappled"].partition(":")
    manifest = json.loads((Path(str(import_module(module).__file__)).parent / name).read_text(encoding="utf-8"))
    assert manifest["name"] == project["name"] == dappled.__name__
    (command,), (reader,) = manifest["contributions"]["commands"], manifest["contributions"]["readers"]
    assert reader["command"] == command["id"]
    assert command["id"].startswith(f"{manifest['name']}.")
    module, _, function = command["python_name"].partition(":")
    return getattr(import_module(module), function)


@pytest.mark.parametrize("kind", [".zarr", ".npz", ".h5"])
@pytest.mark.parametrize("colour", [False, True])
def test_a_light_field_becomes_layers(tmp_path: Path, kind: str, colour: bool, get_reader: Any) -> None:
    path = tmp_path / f"a{kind}"
    light_files.save(path, light_field(colour=colour))
    views, slices = get_reader(str(path))(str(path))
    assert [layer[2] for layer in (views, slices)] == ["image", "image"]
    assert views[0].shape == ((5, 5, 60, 80, 3) if colour else (5, 5, 60, 80))
    assert views[1]["rgb"] is colour
    assert views[1]["name"] == "a views"
    assert views[1]["metadata"]["camera"] == "reference-36mm"
    assert slices[0].shape == (3, 60, 80)
    assert slices[0].dtype == np.float32
    assert 0 < slices[0][1].max() <= 1  # a carrier is as bright as the mean
    assert not slices[1]["visible"]
    assert len(get_reader([str(path)] * 2)([str(path)] * 2)) == 4


def test_files_of_others_are_left_to_their_readers(tmp_path: Path, get_reader: Any) -> None:
    np.savez(tmp_path / "theirs.npz", a=np.ones(3))
    (tmp_path / "no.npz").write_bytes(b"nothing")
    whole = (tmp_path / "theirs.npz").read_bytes()
    (tmp_path / "damaged.npz").write_bytes(whole[: len(whole) // 2] + whole[-22:])  # the end record of a zip is there
    (tmp_path / "theirs.zarr").mkdir()
    with h5py.File(tmp_path / "theirs.h5", "w") as file:
        file["data"] = np.ones(3)
    (tmp_path / "no.h5").write_bytes(b"nothing")
    names = ("theirs.npz", "no.npz", "damaged.npz", "theirs.zarr", "picture.tif", "theirs.h5", "no.h5", "gone.h5")
    for name in names:
        assert get_reader(str(tmp_path / name)) is None
