"""Judge the arrays of a Zarr group or an HDF5 file before they are read.

Both formats can claim any size without a stored byte, and their packed chunks can unpack to more than they claim. What
is read is what `light_files.save` writes, and the same arrays packed again by zstd, Blosc or gzip.
"""

from __future__ import annotations

import math
import os
import stat
import zlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dappled import durable
from dappled.bounds import claims
from dappled.bounds.claims import ClaimError
from dappled.bounds.parsing import MOST_BYTES, parse_json, read_log

_METADATA = "zarr.json"
_MOST_CHUNKS = 20_000  # a light field has one for each slice and view
_READ_AT_ONCE = 10  # chunks, by Zarr
_SLACK_BYTES = 1 << 16  # what packing may add to a chunk that doesn't shrink
_ZSTD = b"\x28\xb5\x2f\xfd"
_GZIP = 16 + zlib.MAX_WBITS
_HDF5_DEFLATE, _HDF5_FILTERS = 1, (1, 2, 3)  # deflate; with byte shuffle and Fletcher's checksum


def zarr_attributes(path: Path, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """Check the arrays of a Zarr v3 group, and return the group's attributes; `kinds` are the arrays' names and types.

    Raises ClaimError, KeyError for an array that is missing, OSError, and ValueError for metadata that is not JSON.
    """
    group = _metadata(path / _METADATA, "group", "group")
    claimed = stored = 0
    for name, kind in kinds.items():
        if not (path / name / _METADATA).is_file():
            raise KeyError(name)
        array = _metadata(path / name / _METADATA, "array", name)
        if array.get("data_type") != np.dtype(kind).name:
            raise ClaimError(f"its {name} is {str(array.get('data_type'))[:40]}, not {np.dtype(kind)}: make it anew")
        packing = _packing(array, name)
        size = np.dtype(kind).itemsize
        chunk, chunks = _chunks(array, name)
        claimed += claims.count(array.get("shape"), name) * size + chunk * size * min(chunks, _READ_AT_ONCE)
        for file in _chunk_files(path / name, name):
            stored += _check_chunk(file, packing, chunk * size, name)
    claims.check_size(claimed, stored, "arrays")
    return _mapping(group.get("attributes", {}), "attributes")


def check_h5(file: Any, names: Collection[str], text_name: str) -> None:
    """Check the datasets of an open HDF5 file, and its attribute `text_name`, which holds text.

    Raises ClaimError, and KeyError for one that is missing.
    """
    claimed = stored = 0
    for name in names:
        if name not in file:
            raise KeyError(name)
        array = file[name]
        linked = type(file.get(name, getlink=True)).__name__ != "HardLink"
        if linked or getattr(array, "is_virtual", False) or getattr(array, "external", None):
            raise ClaimError(f"{name} stands in another file, which is not followed; use a file that holds it itself")
        if not hasattr(array, "chunks"):
            raise ClaimError(f"its {name} is not an array: make it anew")
        if array.dtype.kind not in "fc":
            raise ClaimError(f"its {name} is {str(array.dtype)[:40]}, not numbers: make it anew")
        claimed += claims.count(array.shape, name) * array.dtype.itemsize
        stored += array.id.get_storage_size()
        if array.chunks is not None:
            claimed += _check_h5_chunks(array, name)
    claims.check_size(claimed, min(stored, os.path.getsize(file.filename)), "arrays")
    if text_name not in file.attrs:
        raise KeyError(text_name)
    attribute = file.attrs.get_id(text_name)
    if attribute.shape != () or attribute.get_storage_size() > MOST_BYTES:
        raise ClaimError(f"its {text_name} are not one text: make it anew")


# --- Zarr


def _metadata(path: Path, kind: str, what: str) -> dict[str, Any]:
    found = _mapping(parse_json(read_log(path)), f"metadata of {what}")
    if found.get("node_type") != kind:
        raise ClaimError(f"its {what} is not a Zarr {kind}: make it anew")
    return found


def _mapping(value: Any, what: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ClaimError(f"its {what} is not a JSON object: make it anew")
    return value


def _chunks(array: Mapping[str, Any], name: str) -> tuple[int, int]:
    """Return how many values a chunk has, and how many chunks there are. Raises ClaimError."""
    shape = array.get("shape")
    grid = _mapping(array.get("chunk_grid"), f"chunk_grid of {name}")
    sides = _mapping(grid.get("configuration"), f"chunk_grid of {name}").get("chunk_shape")
    values = claims.count(sides, f"chunks of {name}")
    if not claims.count(shape, name):
        return values, 0
    if not isinstance(shape, list) or not isinstance(sides, list) or len(sides) != len(shape) or not values:
        raise ClaimError(f"the chunks of its {name} don't divide the array: make it anew")
    number = math.prod(math.ceil(whole / side) for whole, side in zip(shape, sides, strict=True))
    if number > _MOST_CHUNKS:
        raise ClaimError(
            f"its {name} has {number} chunks; {_MOST_CHUNKS} is the most that is read: "
            "write it with a chunk for each slice and view"
        )
    return values, number


def _packing(array: Mapping[str, Any], name: str) -> str:
    """Return the codec that chunks are packed with, "" for none. Raises ClaimError for others, and more than one."""
    codecs = array.get("codecs")
    names = [one.get("name") if isinstance(one, dict) else one for one in codecs] if isinstance(codecs, list) else []
    packed = [one for one in names if one not in ("bytes", "transpose", "crc32c")]
    if "bytes" not in names or len(packed) > 1 or not set(packed) <= {"zstd", "blosc", "gzip"}:
        raise ClaimError(
            f"its {name} is packed by {', '.join(str(one)[:40] for one in names) or 'nothing known'}; "
            "one of zstd, blosc and gzip is read: write it so"
        )
    return str(packed[0]) if packed else ""


def _chunk_files(folder: Path, name: str) -> Iterator[Path]:
    """Yield the files below an array's folder, but for its metadata. Raises ClaimError for what is not a plain file."""
    count = 0
    for base, folders, files in os.walk(folder):
        for each in (*folders, *files):
            path, count = Path(base, each), count + 1
            mode = path.lstat().st_mode
            if count > 4 * _MOST_CHUNKS or not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise ClaimError(f"the folder of its {name} holds more than chunks ({each}): make it anew")
        yield from (Path(base, each) for each in files if each != _METADATA)


def _check_chunk(path: Path, packing: str, chunk: int, name: str) -> int:
    """Check that a chunk's file unpacks to `chunk` bytes at most; returns its size. Raises ClaimError and OSError."""
    size = path.stat().st_size
    if size > chunk + chunk // 8 + _SLACK_BYTES:
        raise ClaimError(f"a chunk of its {name} has {claims.in_words(size)}, more than it can have: make it anew")
    if packing == "gzip":
        claims.check_inflated(durable.read_plain(path), chunk, f"chunk of {name}", head=_GZIP)
        return size
    with open(path, "rb", opener=durable.plain_file) as file:
        head = file.read(18)
    claimed = {"zstd": _zstd_claim, "blosc": _blosc_claim}.get(packing, lambda _: 0)(head)
    if claimed is None or claimed > chunk:
        raise ClaimError(
            f"a chunk of its {name} claims {'an unknown size' if claimed is None else claims.in_words(claimed)}, "
            f"where a chunk has {claims.in_words(chunk)}: it is damaged, or made to exhaust memory; make it anew"
        )
    return size


def _zstd_claim(head: bytes) -> int | None:
    """Return the size that a zstd frame unpacks to by its header (RFC 8878, 3.1.1.1); None where it doesn't say."""
    if len(head) < 6 or head[:4] != _ZSTD:
        return None
    mark = head[4]
    single = mark >> 5 & 1
    width = (single, 2, 4, 8)[mark >> 6]
    at = 5 + (0 if single else 1) + (0, 1, 2, 4)[mark & 3]
    if not width or len(head) < at + width:
        return None
    return int.from_bytes(head[at : at + width], "little") + (256 if width == 2 else 0)


def _blosc_claim(head: bytes) -> int | None:
    """Return the size that a Blosc chunk unpacks to by its header; None where it is cut short."""
    return int.from_bytes(head[4:8], "little") if len(head) >= 16 else None


# --- HDF5


def _check_h5_chunks(array: Any, name: str) -> int:
    """Check packed chunks; returns the bytes of one. Raises ClaimError."""
    creation = array.id.get_create_plist()
    filters = [creation.get_filter(number)[0] for number in range(creation.get_nfilters())]
    if not set(filters) <= set(_HDF5_FILTERS):
        raise ClaimError(f"its {name} is packed by an HDF5 filter that is not read: repack it (h5repack -f GZIP=4)")
    size = claims.count(array.chunks, f"chunks of {name}") * array.dtype.itemsize
    if (number := array.id.get_num_chunks()) > _MOST_CHUNKS:
        raise ClaimError(f"its {name} has {number} chunks; {_MOST_CHUNKS} is the most that is read: repack it")
    if _HDF5_DEFLATE in filters:
        for index in range(number):
            chunk = array.id.get_chunk_info(index)
            if chunk.size > size + size // 8 + _SLACK_BYTES:
                raise ClaimError(f"a chunk of its {name} has {claims.in_words(chunk.size)}, more than it can have")
            _, packed = array.id.read_direct_chunk(chunk.chunk_offset)
            claims.check_inflated(packed, size + 4, f"chunk of {name}")
    return int(size)
