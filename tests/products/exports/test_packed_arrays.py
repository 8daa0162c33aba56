"""Light fields that claim more than they hold: one sentence, before memory is taken."""

from __future__ import annotations

import json
import os
import resource
import shutil
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import zarr
import zarr.codecs
from numcodecs import Blosc, GZip, Zstd

from dappled.errors import DappledError
from dappled.products.exports.light_files import load, save
from tests.products.exports.test_light_files import light_field

NAMES = ("slices", "carriers", "views", "view_offsets", "grid")


@pytest.fixture(autouse=True)
def _memory(request: pytest.FixtureRequest) -> Any:
    """No hostile file takes half a gigabyte more than the process had at its highest."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 500_000 or request.node.get_closest_marker("slow")


@pytest.fixture
def group(tmp_path: Path) -> Path:
    path = tmp_path / "a.zarr"
    save(path, light_field())
    return path


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    metadata = json.loads(path.read_text())
    change(metadata)
    path.write_text(json.dumps(metadata))


def refuses(path: Path, words: str) -> None:
    with pytest.raises(DappledError, match=words) as caught:
        load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


# --- Zarr


def test_a_group_of_two_small_files_claims_20_gib(group: Path) -> None:
    edit(group / "slices" / "zarr.json", lambda m: m.update(shape=[5, 20_000, 26_844]))
    edit(
        group / "slices" / "zarr.json",
        lambda m: m["chunk_grid"]["configuration"].update(chunk_shape=[1, 20_000, 26_844]),
    )
    shutil.rmtree(group / "slices" / "c")
    refuses(group, r"its arrays would take .* GB of memory, and the .* that are stored can't hold")


def test_chunks_larger_than_their_array(group: Path) -> None:
    edit(
        group / "slices" / "zarr.json", lambda m: m["chunk_grid"]["configuration"].update(chunk_shape=[1, 10**6, 10**6])
    )
    refuses(group, "would take .* of memory")


@pytest.mark.parametrize("sides", [[1, 1, 1], [5, 4], [0, 4, 6], "x", None])
def test_chunks_that_divide_nothing(group: Path, sides: object) -> None:
    edit(group / "slices" / "zarr.json", lambda m: m.update(shape=[500, 400, 600]))
    edit(group / "slices" / "zarr.json", lambda m: m["chunk_grid"]["configuration"].update(chunk_shape=sides))
    refuses(group, "chunks")


def test_a_chunk_that_unpacks_to_more_than_it_claims(group: Path) -> None:
    bomb = Zstd(level=1).encode(bytes(600_000_000))
    assert len(bomb) < 100_000
    (group / "slices" / "c" / "0" / "0" / "0").write_bytes(bomb)
    refuses(group, "a chunk of its slices claims 600 MB, where a chunk has 192 bytes")


def test_a_chunk_longer_than_a_chunk(group: Path) -> None:
    (group / "slices" / "c" / "0" / "0" / "0").write_bytes(bytes(100_000))
    refuses(group, "a chunk of its slices has 100 kB, more than it can have")


def test_a_chunk_that_is_no_file(group: Path) -> None:
    chunk = group / "slices" / "c" / "0" / "0" / "0"
    chunk.unlink()
    os.mkfifo(chunk)
    refuses(group, r"holds more than chunks \(0\)")


@pytest.mark.parametrize(
    "codecs",
    [[{"name": "bytes"}, {"name": "numcodecs.bz2"}], [{"name": "bytes"}, {"name": "zstd"}, {"name": "zstd"}], [], "x"],
)
def test_codecs_that_are_not_known(group: Path, codecs: object) -> None:
    edit(group / "slices" / "zarr.json", lambda m: m.update(codecs=codecs))
    refuses(group, "its slices is packed by")


def test_consolidated_metadata_is_not_believed(group: Path) -> None:
    with pytest.warns(match="Consolidated metadata"):
        zarr.consolidate_metadata(group)
    edit(
        group / "zarr.json",
        lambda m: m["consolidated_metadata"]["metadata"]["slices"].update(shape=[5, 10**6, 10**6]),
    )
    assert load(group).slices.shape == (5, 4, 6)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": ' + "1" * 5000 + "}", "[]", "{}", '{"attributes": 1}', "\xff"])
def test_metadata_that_is_hostile(group: Path, text: str) -> None:
    for place in (group / "zarr.json", group / "grid" / "zarr.json"):
        kept = place.read_text()
        place.write_text(text, encoding="latin-1")
        with pytest.raises(DappledError):
            load(group)
        place.write_text(kept)


@pytest.mark.parametrize("codec", [zarr.codecs.ZstdCodec(), zarr.codecs.BloscCodec(), zarr.codecs.GzipCodec(), None])
def test_arrays_that_were_packed_again_come_back(tmp_path: Path, codec: Any) -> None:
    field, path = light_field(), tmp_path / "b.zarr"
    made = zarr.open_group(store=path, mode="w", zarr_format=3, attributes={"shape": [20, 24]})
    for name in NAMES:
        values = getattr(field, name)
        made.create_array(name, data=values, chunks=(2, *values.shape[1:]), compressors=codec)
    np.testing.assert_array_equal(load(path).slices, field.slices)


@pytest.mark.parametrize("name", ["gzip", "blosc"])
def test_bombs_of_the_other_codecs(group: Path, name: str) -> None:
    codec: Any = {"gzip": GZip(1), "blosc": Blosc()}[name]
    edit(group / "slices" / "zarr.json", lambda m: m.update(codecs=[{"name": "bytes"}, {"name": name}]))
    for chunk in (group / "slices" / "c").rglob("*"):
        if chunk.is_file():
            chunk.write_bytes(codec.encode(bytes(60_000_000)))
    refuses(group, "a chunk of its slices (has|claims) |its chunk of slices unpacks to more")


# --- NPZ


def npz(path: Path, **members: bytes) -> Path:
    """A light field in NPZ, with these members in place of its own."""
    save(path, light_field(), overwrite=True)
    with zipfile.ZipFile(path) as old:
        kept = {name: old.read(name) for name in old.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        for name, data in {**kept, **{f"{name}.npy": data for name, data in members.items()}}.items():
            new.writestr(name, data)
    return path


def header(text: str, version: int = 1) -> bytes:
    size = len(text).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + size + text.encode()


def claim(shape: str, descr: str = "'<c8'") -> bytes:
    return header(f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n")


def test_a_small_npz_of_much_nothing(tmp_path: Path) -> None:
    path = npz(tmp_path / "a.npz", slices=claim("(1, 7000, 5000)") + bytes(8 * 7000 * 5000))
    assert path.stat().st_size < 1_300_000  # packed at zlib's quickest
    refuses(path, "its arrays would take 280 MB of memory")


def test_a_claim_of_a_million_million_floats(tmp_path: Path) -> None:
    refuses(npz(tmp_path / "a.npz", slices=claim("(1000000, 1000, 1000)")), "its arrays would take 8 TB of memory")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (header("", 2)[:8] + (2**31).to_bytes(4, "little") + bytes(10**7), "header of its slices claims 2.15 GB"),
        (claim("(5, 4, 6)", "'|O'"), "not numbers or text"),
        (claim("(-5, 4, 6)"), "a side that is not a whole number"),
        (claim(f"({10**30}, 4, 6)"), "a side that is not a whole number"),
        (claim("(" * 3000), "can't be read"),
        (claim("-" * 9000 + "1"), "can't be read"),
        (claim("(5, 4, 6)", "'<U9999999'"), "would take"),
        (claim("(5, 4, 6)"), "is damaged"),
        (b"\x93NUMPY\x03\x00", "NPY's version 3"),
        (b"", "is damaged"),
    ],
)
def test_headers_that_are_hostile(tmp_path: Path, data: bytes, words: str) -> None:
    refuses(npz(tmp_path / "a.npz", slices=data), words)


@pytest.mark.parametrize("text", ["[" * 50_000, "1" * 5000, "[]", "x"])
def test_attributes_of_npz_that_are_hostile(tmp_path: Path, text: str) -> None:
    descr = f"'<U{len(text)}'"
    path = npz(tmp_path / "a.npz", attributes=claim("()", descr) + text.encode("utf-32-le"))
    with pytest.raises(DappledError, match=str(path)):
        load(path)


# --- HDF5


@pytest.fixture
def h5(tmp_path: Path) -> Path:
    path = tmp_path / "a.h5"
    save(path, light_field())
    return path


def replaced(path: Path, make: Callable[[Any], object]) -> Path:
    with h5py.File(path, "r+") as file:
        del file["slices"]
        make(file)
    return path


def test_a_dataset_without_a_stored_byte(h5: Path) -> None:
    replaced(h5, lambda file: file.create_dataset("slices", (5, 20_000, 26_844), np.complex64))
    refuses(h5, "its arrays would take 21.5 GB of memory")


def test_a_dataset_of_one_great_chunk(h5: Path) -> None:
    replaced(
        h5,
        lambda file: file.create_dataset(
            "slices", (5, 4, 6), np.complex64, chunks=(1, 10_000, 40_000), maxshape=(None,) * 3
        ),
    )
    refuses(h5, "would take 3.2 GB of memory")


def test_a_packed_chunk_that_unpacks_to_more(h5: Path) -> None:
    def make(file: Any) -> None:
        made = file.create_dataset("slices", (5, 4, 6), np.complex64, chunks=(5, 4, 6), compression="gzip")
        made.id.write_direct_chunk((0, 0, 0), zlib.compress(bytes(60_000_000)))

    refuses(replaced(h5, make), "its chunk of slices unpacks to more than")


def test_a_dataset_that_lies_elsewhere(h5: Path, tmp_path: Path) -> None:
    zeros = [("/dev/zero", 0, h5py.h5f.UNLIMITED)]
    replaced(h5, lambda file: file.create_dataset("slices", (5, 4, 6), np.complex64, external=zeros))
    refuses(h5, "slices stands in another file")
    replaced(h5, lambda file: file.update({"slices": h5py.ExternalLink(str(tmp_path / "no.h5"), "slices")}))
    with pytest.raises(DappledError):
        load(h5)


def test_filters_that_are_not_known(h5: Path) -> None:
    replaced(h5, lambda file: file.create_dataset("slices", (5, 4, 6), np.complex64, compression="lzf"))
    refuses(h5, "by an HDF5 filter that is not read")


def test_datasets_that_were_packed_again_come_back(h5: Path) -> None:
    values = light_field().slices
    replaced(
        h5,
        lambda file: file.create_dataset(
            "slices", data=values, chunks=(1, 4, 6), compression="gzip", shuffle=True, fletcher32=True
        ),
    )
    np.testing.assert_array_equal(load(h5).slices, values)


@pytest.mark.parametrize("value", ["[" * 50_000, np.zeros(5), 7.0, np.zeros((2, 2), "S3"), "[]"])
def test_attributes_of_h5_that_are_hostile(h5: Path, value: Any) -> None:
    with h5py.File(h5, "r+") as file:
        file.attrs["attributes"] = value
    with pytest.raises(DappledError, match=str(h5)):
        load(h5)


# --- values that readers calculate with


@pytest.mark.parametrize(
    ("name", "value"),
    [("shape", 5), ("shape", [1]), ("shape", ["a", "b"]), ("shape", [0, 4]),
     ("focal_length_mm", "x"), ("f_number", True), ("camera", 5), ("aperture", []), ("noise_rms", {})],
)  # fmt: skip
def test_attributes_of_a_wrong_kind_are_named(group: Path, name: str, value: object) -> None:
    edit(group / "zarr.json", lambda m: m["attributes"].update({name: value}))
    refuses(group, f"its attribute {name} is not")


# --- large and honest


@pytest.mark.long
@pytest.mark.parametrize("kind", [".zarr", ".npz", ".h5"])
def test_a_light_field_of_half_a_gigabyte_opens(tmp_path: Path, kind: str) -> None:
    rng, field = np.random.default_rng(4), light_field(views=5)
    slices = rng.random((13, 1200, 2000), dtype=np.float32).astype(np.complex64)
    large = replace(
        field, slices=slices, carriers=rng.random((13, 4)), views=rng.random((5, 5, 1200, 2000), dtype=np.float32)
    )
    save(tmp_path / f"a{kind}", large)
    found = load(tmp_path / f"a{kind}")
    np.testing.assert_array_equal(found.slices, slices)
    np.testing.assert_array_equal(found.views, large.views)


@pytest.mark.timeout(20)
def test_a_pipe_in_place_of_metadata_is_not_waited_for(group: Path) -> None:
    for file in (group / "slices" / "zarr.json", group / "zarr.json"):
        file.unlink()
        os.mkfifo(file)
        refuses(group, "no plain file|lacks .slices.")
