from __future__ import annotations

import json
import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import zarr

from dappled import codec
from dappled.decode.lightfield.light_field import LightField
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, finding
from dappled.products.exports import light_files
from dappled.products.exports.light_files import load, save

KINDS = [".zarr", ".npz", ".h5"]
ATTRIBUTES = {
    "frame_shape": [20, 24],
    "camera": "reference-5x5",
    "focal_length_mm": 50.0,
    "calibration": None,
    "pose": {"latitude_rad": 0.72, "attitude": [1, 0, 0, 0]},
}


def light_field(*, colour: bool = False, views: int = 3) -> LightField:
    rng = np.random.default_rng(5)
    slices = (rng.standard_normal((5, 4, 6)) + 1j * rng.standard_normal((5, 4, 6))).astype(np.complex64)
    shape = (views, views, 4, 6, 3) if colour else (views, views, 4, 6)
    return LightField(
        slices=slices,
        carriers=rng.standard_normal((5, 4)),
        views=rng.random(shape).astype(np.float32),
        view_offsets=rng.random((views, views, 2)),
        grid=rng.standard_normal((2, 3)),
        attributes=ATTRIBUTES,
    )


def needs(kind: str) -> None:
    if kind == ".h5":
        pytest.importorskip("h5py", reason="HDF5 is an extra")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("colour", [False, True])
def test_a_light_field_comes_back(tmp_path: Path, kind: str, colour: bool) -> None:
    needs(kind)
    path, field = tmp_path / f"a{kind}", light_field(colour=colour)
    save(path, field)
    found = load(path)
    for name in ("slices", "carriers", "views", "view_offsets", "grid"):
        before, after = getattr(field, name), getattr(found, name)
        assert after.dtype == before.dtype
        np.testing.assert_array_equal(after, before)
    assert found.attributes == ATTRIBUTES
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("kind", KINDS)
def test_a_field_without_views_comes_back(tmp_path: Path, kind: str) -> None:
    needs(kind)
    field = light_field(views=0)
    save(tmp_path / f"a{kind}", field)
    assert load(tmp_path / f"a{kind}").views.shape == (0, 0, 4, 6)


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_overwritten_unasked(tmp_path: Path, kind: str) -> None:
    needs(kind)
    path, first, second = tmp_path / f"a{kind}", light_field(), replace(light_field(), attributes={"n": 2})
    save(path, first)
    with pytest.raises(DappledError, match="exists already"):
        save(path, second)
    assert load(path).attributes == ATTRIBUTES
    save(path, second, overwrite=True)
    assert load(path).attributes == {"n": 2}
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("kind", KINDS)
def test_a_write_that_fails_leaves_what_was_there(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    needs(kind)
    path = tmp_path / f"a{kind}"
    save(path, light_field())

    def refuse(_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(DappledError, match=r"can't be written: No space left"):
        save(path, replace(light_field(), attributes={}), overwrite=True)
    monkeypatch.undo()
    assert load(path).attributes == ATTRIBUTES
    assert os.listdir(tmp_path) == [path.name]


def test_an_npz_that_lacks_an_array_is_refused_by_its_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", views=np.zeros(2))
    with pytest.raises(DappledError, match=r"a.npz is not a light field: it lacks 'attributes'$"):
        load(tmp_path / "a.npz")


def test_others_can_read_zarr_and_npz(tmp_path: Path) -> None:
    field = light_field()
    save(tmp_path / "a.zarr", field)
    save(tmp_path / "a.npz", field)
    group = zarr.open_group(store=tmp_path / "a.zarr", mode="r")
    assert group.metadata.zarr_format == 3
    assert group.attrs["focal_length_mm"] == 50.0
    with np.load(tmp_path / "a.npz") as file:
        assert json.loads(str(file["attributes"])) == ATTRIBUTES


def test_others_can_read_h5(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="HDF5 is an extra")
    save(tmp_path / "a.h5", light_field())
    with h5py.File(tmp_path / "a.h5") as file:
        assert file.attrs["focal_length_mm"] == 50.0
        assert json.loads(file.attrs["frame_shape"]) == [20, 24]


def test_attributes_may_hold_numpy_numbers_and_paths(tmp_path: Path) -> None:
    save(
        tmp_path / "a.npz", replace(light_field(), attributes={"a": np.float32(0.5), "b": np.arange(2), "p": tmp_path})
    )
    assert load(tmp_path / "a.npz").attributes == {"a": 0.5, "b": [0, 1], "p": str(tmp_path)}


@pytest.mark.parametrize("bad", [float("nan"), object()])
def test_attributes_that_are_no_json_are_told(tmp_path: Path, bad: object) -> None:
    with pytest.raises(DappledError, match="don't fit into JSON"):
        save(tmp_path / "a.npz", replace(light_field(), attributes={"a": bad}))


def test_without_hdf5_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(DappledError, match=r"pip install 'dappled\[ground\]'"):
        save(tmp_path / "a.h5", light_field())


def test_doubts_that_are_no_findings_are_told(tmp_path: Path) -> None:
    for bad in (
        5,
        "one",
        [1],
        [{"code": "no.such", "level": "note", "subject": {"kind": "frame", "which": ""}, "facts": {}}],
    ):
        save(tmp_path / "a.npz", replace(light_field(), attributes={"doubts": bad}), overwrite=True)
        with pytest.raises(DappledError, match="its attribute doubts is not a list of findings"):
            load(tmp_path / "a.npz")


@pytest.mark.parametrize("kind", KINDS)
def test_standard_errors_of_views_are_kept_and_old_files_have_none(tmp_path: Path, kind: str) -> None:
    needs(kind)
    plain = light_field()
    sigma = np.arange(np.prod([*plain.views.shape[:2], 3, 4]), dtype=np.float32).reshape(*plain.views.shape[:2], 3, 4)
    save(tmp_path / f"new{kind}", replace(plain, view_sigma=sigma))
    np.testing.assert_array_equal(load(tmp_path / f"new{kind}").view_sigma, sigma)
    save(tmp_path / f"old{kind}", plain)
    assert load(tmp_path / f"old{kind}").view_sigma is None


@pytest.mark.parametrize("name", ["a.tiff", "a"])
def test_other_extensions_are_told(tmp_path: Path, name: str) -> None:
    for act in (lambda: save(tmp_path / name, light_field()), lambda: load(tmp_path / name)):
        with pytest.raises(DappledError, match=r"ends in \.zarr, \.npz or \.h5"):
            act()


def test_shapes_that_contradict_are_told(tmp_path: Path) -> None:
    for field, words in (
        (replace(light_field(), carriers=np.zeros((4, 4))), "carriers has the shape"),
        (replace(light_field(), slices=np.zeros((4, 6), np.complex64)), "slices has 2 dimensions"),
        (replace(light_field(), view_offsets=np.zeros((3, 2, 2))), "view_offsets has the shape"),
    ):
        with pytest.raises(DappledError, match=words):
            save(tmp_path / "a.npz", field)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("kind", KINDS)
def test_missing_and_damaged_files_are_told(tmp_path: Path, kind: str) -> None:
    needs(kind)
    path = tmp_path / f"a{kind}"
    with pytest.raises(DappledError, match="there is no light field"):
        load(path)
    path.write_bytes(b"garbage" * 50)
    with pytest.raises(DappledError, match="is not a light field"):
        load(path)


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_that_lacks_an_array_is_told(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    needs(kind)
    path = tmp_path / f"a{kind}"
    without = {name: value for name, value in light_files._ARRAYS.items() if name != "grid"}
    with monkeypatch.context() as patch:
        patch.setattr(light_files, "_ARRAYS", without)
        patch.setattr(light_files, "_fits", lambda *_: None)
        save(path, light_field())
    with pytest.raises(DappledError, match=r"not a light field.*grid"):
        load(path)


@pytest.mark.slow  # xarray is not in the smaller environment
@pytest.mark.parametrize("colour", [False, True])
def test_xarray_reads_the_axes_and_units(tmp_path: Path, colour: bool) -> None:
    path = tmp_path / "a.zarr"
    field = light_field(colour=colour)
    save(path, field)
    xarray = pytest.importorskip("xarray")
    with xarray.open_zarr(path, consolidated=False, chunks=None) as found:
        assert found.views.dims == ("v", "u", "y", "x", "channel")[: field.views.ndim]
        assert found.slices.dims == ("slice", "y", "x")
        assert found.carriers.attrs["units"] == "cycles/pixel"
        np.testing.assert_array_equal(found.views.isel(v=1, u=2), field.views[1, 2])
        assert found.attrs["focal_length_mm"] == field.attributes["focal_length_mm"]


def test_hdf5_has_the_axes_and_units_too(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    save(path, light_field())
    with h5py.File(path) as found:
        assert [axis.label for axis in found["views"].dims] == ["v", "u", "y", "x"]
        assert found["grid"].attrs["units"] == "pixel"
        assert found.attrs["focal_length_mm"] == 50.0


@pytest.mark.slow  # as above
def test_slices_of_another_size_have_axes_of_their_own(tmp_path: Path) -> None:
    field = replace(light_field(), slices=np.ones((3, 10, 20), dtype=np.complex64), carriers=np.zeros((3, 4)))
    path = tmp_path / "a.zarr"
    save(path, field)
    xarray = pytest.importorskip("xarray")
    with xarray.open_zarr(path, consolidated=False, chunks=None) as found:
        assert dict(found.sizes) == {
            "slice": 3, "slice_y": 10, "slice_x": 20, "v": 3, "u": 3, "y": 4, "x": 6,
            "carrier": 4, "direction": 2, "term": 3,
        }  # fmt: skip


def test_the_pages_programs_read_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = (Path(__file__).parents[3] / "docs" / "lightfield.md").read_text(encoding="utf-8")
    said = {**ATTRIBUTES, "doubts": [codec.plain(finding(Code.MASK_TURNED, FRAME, by_deg=0.1))]}
    carriers = np.array([[0, 0, 0, 0], [0, 1, 0, 0.1], [1, 0, 0.1, 0], [1, 1, 0.1, 0.1], [1, -1, 0.1, -0.1]])
    one = replace(light_field(), carriers=carriers, slices=np.ones((5, 4, 6), dtype=np.complex64), attributes=said)
    save(tmp_path / "frame.npz", one)
    monkeypatch.chdir(tmp_path)
    exec(re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)[0], {})  # noqa: S102  # our own page
    told = capsys.readouterr().out
    assert "50.0 mm, doubts: ['mask.turned']" in told
    assert "order (+1, +0) at (+0.1000, +0.0000) cycles/pixel: 1.0000" in told
