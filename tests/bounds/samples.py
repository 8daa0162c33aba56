"""Inputs for every door: honest ones, bombs made by hand, and mutations of both from a seed."""

from __future__ import annotations

import hashlib
import io
import json
import random
import re
import shutil
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import rasterio
import tifffile
import tomli_w
from numcodecs import Zstd
from numpy.typing import NDArray
from PIL import Image

from dappled.clock import RecordedClock
from dappled.config import profiles, settings
from dappled.decode.calibration import Calibration, LatticeFit
from dappled.decode.optics import Lattice
from dappled.drivers.mavlink import mavlink
from dappled.drivers.raw import calibration_files
from dappled.findings import Code, Subject, finding
from dappled.flight import Ledger, recording, seals
from dappled.products.exports import light_files
from tests.drivers.raw.test_reading import dng
from tests.flight import makers
from tests.products.exports.test_light_files import light_field
from tests.simulated import lytro

DEEP, LONG, FRAME = "[" * 100_000, "9" * 5000, "9" * 26
_NUMBERS = (
    "0", "-1", "1e999", FRAME, LONG, "2147483648", "1000000000000", "NaN", "null", "true", '"x"', "[]", "{}", "[[[]]]",
)  # fmt: skip
_SHAPE = (48, 64)  # of small pictures


DOORS = (
    "zarr", "npz", "h5", "settings", "profile", "calibration", "calibration-npz", "facts", "journal", "telemetry",
    "flight", "index",
    "manifest", "sidecar", "question", "message", "console", "dng", "lfp", "lytro-raw", "tiff", "png", "jpeg", "npy",
    "views", "mask-png", "mask-tiff", "density", "control-points", "background", "terrain", "base-map",
)  # fmt: skip


def honest(folder: Path) -> dict[str, Path]:
    """Make an honest input for each door, in `folder`."""
    made: dict[str, Path] = {}
    for kind in ("zarr", "npz", "h5"):
        made[kind] = folder / f"a.{kind}"
        light_files.save(made[kind], light_field())
    for door, files in _honest_files().items():
        place = folder / door
        place.mkdir()
        for name, data in files.items():
            (place / name).write_bytes(data.encode() if isinstance(data, str) else data)
        made[door] = place if door in _FOLDERS else place / next(iter(files))
    made["calibration"], made["calibration-npz"] = calibration_files.save(folder / "c.toml", _calibration())
    made["flight"] = _flight(folder / "flights")
    made["index"] = folder / "index"
    made["index"].mkdir()
    shutil.copy(folder / "flights" / "index.sqlite", made["index"])
    made["terrain"] = made["base-map"] = _raster(folder / "a.terrain.tif")
    return made


_FOLDERS = ("facts", "manifest", "views", "background", "lytro-raw")
_SHOT = '{"cause":{"kind":"k","sequence":null,"source":"s"},"index":%s,"wished_monotonic_ns":1,"wished_utc_ns":1}\n'
_LINE = (
    '{"key":"%s","flight":"f","frame":"g","outputs":[{"name":"a/b.zarr","kind":"lightfield","size":%s,"sha256":"0"}],'
    '"error":null,"seconds":1.0,"cpu_seconds":1.0,"peak_mb":1.0}\n'
)


def _honest_files() -> dict[str, dict[str, bytes | str]]:
    values = np.random.default_rng(1).integers(300, 4000, _SHAPE).astype(np.uint16)
    eight, told = (values // 16).astype(np.uint8), lytro.metadata(_SHAPE)
    small = _picture(eight, "PNG")
    shipped = Path(profiles.__file__).parent / "profiles" / "cameras" / "fujifilm-s5200.toml"
    return {
        "settings": {"a.toml": tomli_w.dumps(settings.to_tables(settings.Settings()))},
        "profile": {"a.toml": shipped.read_text(encoding="utf-8")},
        "facts": {"flight.toml": "[a]\nb = 1\n"},
        "journal": {"shots.jsonl": _SHOT % "7" + _SHOT % "8"},
        "telemetry": {"a.tlog": _telemetry()},
        "manifest": {"manifest.jsonl": _LINE % ("a", 5) + _LINE % ("b", 6)},
        "sidecar": {"a.xmp": '<x xmp:CreatorTool="dappled"/>'},
        "question": {"q": '{"get": "slices", "frame": 42, "flight": "f"}'},
        "message": {"m": _message("<c8", [1, 2, 2], bytes(32))},
        "console": {"r": _request("GET", "/api/frames/4/thumb.jpg")},
        "dng": {"a.dng": dng(values)},
        "lfp": {"a.lfp": lytro.container(values, told)},
        "lytro-raw": {"a.raw": lytro.packed(values, 12, "big"), "a.json": json.dumps(told)},
        "tiff": {"a.tif": _tiff(values, compression="zlib")},
        "png": {"a.png": _picture(values, "PNG")},
        "jpeg": {"a.jpg": _picture(eight, "JPEG")},
        "npy": {"a.npy": _npy(values)},
        "views": {f"{number}.png": small for number in range(4)},
        "mask-png": {"a.png": _picture(eight, "PNG", dpi=(1000, 1000))},
        "mask-tiff": {"a.tif": _tiff(values, resolution=(1000, 1000))},
        "density": {"a.csv": "level,density\n0,3.0\n128,1.0\n255,0.1\n"},
        "control-points": {"a.csv": "name,frame,column,row,latitude,longitude,altitude\na,000001,5,6,41.6,-91.5,200\n"},
        "background": {"map.png": small, "map.pgw": "0.1\n0\n0\n-0.1\n5\n50\n"},
    }


def bombs(honest_ones: dict[str, Path], folder: Path) -> Iterator[tuple[str, str, Path]]:
    """(door, name, input): made by hand, each of a few hundred kilobytes at most."""
    for door, name, data in _flat_bombs(honest_ones["terrain"].read_bytes()):
        place = folder / f"{door}-{name}{honest_ones[door].suffix}"
        place.write_bytes(data.encode() if isinstance(data, str) else data)
        yield door, name, place
    for door, name, parts in _folder_bombs():
        place = folder / f"{door}-{name}{honest_ones[door].suffix}"
        shutil.copytree(honest_ones[door], place)
        for inner, data in parts.items():
            (place / inner).write_bytes(data.encode() if isinstance(data, str) else data)
        yield door, name, place
    for name, change in _H5_BOMBS.items():
        place = folder / f"h5-{name}.h5"
        shutil.copy(honest_ones["h5"], place)
        with h5py.File(place, "r+") as file:
            del file["slices"]
            change(file)
        yield "h5", name, place
    for name, members in _npz_bombs().items():
        place = folder / f"npz-{name}.npz"
        _repack(honest_ones["npz"], place, members)
        yield "npz", name, place


def _flat_bombs(raster: bytes) -> Iterator[tuple[str, str, bytes | str]]:
    values = np.zeros(_SHAPE, np.uint16)
    for door in ("settings", "profile", "calibration"):
        for name, text in {
            "deep": f"a = {DEEP}", "long": f"a = {LONG}", "hex": f"a = 0x{'f' * 5000}",
            "dots": "a" + ".a" * 100_000 + "=1",
            "tables": "a = " + "{b=" * 100_000, "big": "#" * 5_000_000, "inf": "[mask]\np = inf", "bytes": "a = '\xff'",
        }.items():  # fmt: skip
            yield door, name, text.encode("latin-1")
    for door, line in {"journal": _SHOT, "question": '{"get": "slices", "frame": %s}'}.items():
        for name, value in {"deep": DEEP, "long": LONG, "frame": FRAME, "big": '"' + "a" * 5_000_000 + '"'}.items():
            yield door, name, line % value
    for name, entry in {
        "floats": ("<f4", [10**12]), "sides": ("<f4", [2**62] * 8), "objects": ("O", [1]), "void": ("V999999999", [1]),
        "nested": ("(1000000,1000000)f4", [1]),
    }.items():  # fmt: skip
        yield "message", name, _message(*entry, b"")
    yield "message", "deep", DEEP
    yield "message", "long", f'{{"seq": {LONG}}}\n'
    for name, request in {
        "frame-26": _request("GET", f"/api/frames/{FRAME}/thumb.jpg"),
        "frame": _request("GET", f"/api/frames/{LONG}/mean.jpg"),
        "kml": _request("GET", f"/kml/{LONG}.png"), "deep": _request("POST", "/api/shoot", DEEP[:4000]),
        "long": _request("POST", "/api/shoot", f'{{"sequence": {LONG[:4000]}}}'),
        "length": _request("POST", "/api/shoot", "{}", length="9" * 4000), "static": _request("GET", "/static/%00"),
        "name": _request("GET", "/static/" + "a" * 5000),
        "chunks": _request("POST", "/api/shoot", "5\r\n{}   \r\n0\r\n\r\n", chunked=True),
    }.items():  # fmt: skip
        yield "console", name, request
    huge = _png_head(2**31 - 1, 2**31 - 1), _png_head(60_000, 60_000), _png_zeros(9000, 9000)
    for door in ("png", "mask-png"):
        for name, data in zip(("claim", "large", "zeros"), huge, strict=True):
            yield door, name, data
    for door, small in {
        "tiff": _tiff(values),
        "mask-tiff": _tiff(values),
        "terrain": raster,
        "base-map": raster,
    }.items():
        for name, tags in {
            "claim": {256: 2**31 - 1, 257: 2**31 - 1}, "large": {256: 60_000, 257: 60_000, 278: 60_000},
            "rows": {278: 2**32 - 1}, "samples": {277: 20_000},
        }.items():  # fmt: skip
            yield door, name, _with_tags(small, tags)
        yield door, "strip", _tiff_bomb(small)
    yield "dng", "claim", _with_tags(dng(values), {256: 2**31 - 2, 257: 2**31 - 2})
    yield "dng", "large", _with_tags(dng(values), {256: 30_000, 257: 30_000, 278: 30_000})
    yield "npy", "claim", npy_claim("(1000000, 1000000)", "<f4")
    yield "npy", "deep", npy_header("(" * 9000)
    for name, told in {"deep": '{"image": ' + DEEP, "wide": '{"image": [' + "[]," * 1_390_000 + "[]]}"}.items():
        yield "lfp", name, lytro.container(values, lytro.metadata(_SHAPE)) + _lfp_part(told.encode())
    for door, head in {
        "density": "level,density\n",
        "control-points": "name,frame,column,row,latitude,longitude,altitude\n",
    }.items():
        yield door, "field", head + '"' + "a" * 200_000 + '",1\n'
        yield door, "rows", head + "1,2,3,4,5,6,7\n" * 400_000
        yield door, "nul", head + "\0,1\n"
        yield door, "long", head + f"{LONG},{LONG},{LONG},{LONG},{LONG},{LONG},{LONG}\n"
    yield "sidecar", "big", "a" * 20_000_000
    yield "telemetry", "stamps", b"\xff" * 200_000
    yield "telemetry", "lengths", (b"\0" * 8 + b"\xfd\xff" + b"\0" * 10) * 10_000


def _folder_bombs() -> Iterator[tuple[str, str, Mapping[str, bytes | str]]]:
    for name, value in {"deep": DEEP, "long": LONG, "frame": FRAME}.items():
        yield "facts", name, {"flight.toml": f"a = {value}"}
        yield "manifest", name, {"manifest.jsonl": _LINE % ("a", value)}
        yield "lytro-raw", name, {"a.json": f'{{"image": {{"width": {value}}}}}'}
        yield "zarr", name, {"zarr.json": f'{{"zarr_format": 3, "node_type": "group", "attributes": {{"a": {value}}}}}'}
    for name, (shape, chunk) in {
        "20-gib": ([5, 20_000, 26_844], [1, 20_000, 26_844]), "floats": ([10**12, 1, 1], [1, 1, 1]),
        "chunks": ([5, 4, 6], [10**6, 10**6, 1]), "many": ([5000, 80, 80], [1, 1, 1]),
        "sides": ([2**63, 0, 1], [1, 1, 1]),
    }.items():  # fmt: skip
        yield "zarr", name, {"slices/zarr.json": _zarr_array(shape, chunk)}
    yield "zarr", "zstd", {"slices/c/0/0/0": Zstd(level=1).encode(bytes(300_000_000))}
    yield "background", "large", {"map.png": _png_head(60_000, 60_000)}
    yield "background", "world", {"map.pgw": "1\n" * 10_000_000}
    yield "background", "long", {"map.pgw": f"{LONG}\n" * 6}
    yield "views", "large", {"0.png": _png_head(60_000, 60_000)}
    yield "views", "zeros", {f"{number}.png": _png_zeros(5000, 5000) for number in range(4)}
    yield "views", "postscript", {"0.png": "%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"}


_H5_BOMBS: Mapping[str, Callable[[Any], object]] = {
    "claim": lambda file: file.create_dataset("slices", (5, 20_000, 26_844), np.complex64),
    "chunk": lambda file: file.create_dataset(
        "slices", (5, 4, 6), np.complex64, chunks=(1, 10_000, 40_000), maxshape=(None,) * 3
    ),
    "chunks": lambda file: file.create_dataset("slices", (500, 400, 600), np.complex64, chunks=(1, 1, 1)),
    "packed": lambda file: file.create_dataset(
        "slices", (5, 4, 6), np.complex64, chunks=(5, 4, 6), compression="gzip"
    ).id.write_direct_chunk((0, 0, 0), zlib.compress(bytes(60_000_000))),
    "outside": lambda file: file.create_dataset(
        "slices", (5, 4, 6), np.complex64, external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)]
    ),
    "group": lambda file: file.create_group("slices"),
    "deep": lambda file: (file.create_dataset("slices", data=np.zeros((1, 1, 1), np.complex64)),
                          file.attrs.modify("attributes", DEEP[:60_000])),
}  # fmt: skip


def _npz_bombs() -> dict[str, dict[str, bytes]]:
    return {
        "zeros": {"slices": npy_claim("(1, 7000, 5000)") + bytes(8 * 7000 * 5000)},
        "floats": {"slices": npy_claim("(1000000, 1000, 1000)")},
        "header": {"slices": b"\x93NUMPY\x02\x00" + (2**31).to_bytes(4, "little") + bytes(10**7)},
        "minus": {"slices": npy_claim("-" * 9000 + "1")},
        "parens": {"slices": npy_claim("(" * 3000)},
        "objects": {"slices": npy_claim("(5, 4, 6)", "|O")},
        "deep": {"attributes": npy_claim("()", "<U50000") + DEEP[:50_000].encode("utf-32-le")},
        "long": {"attributes": npy_claim("()", "<U5000") + LONG.encode("utf-32-le")},
    }


def mutated(source: Path, target: Path, chance: random.Random) -> Path:
    """Copy an input, changed in one to eight places."""
    if source.is_dir():
        shutil.copytree(source, target)
        files = sorted(path for path in target.rglob("*") if path.is_file())
        victim = chance.choice(files)
        victim.write_bytes(_changed(victim.read_bytes(), chance))
    elif zipfile.is_zipfile(source) and chance.random() < 0.5:
        with zipfile.ZipFile(source) as archive:
            name = chance.choice(archive.namelist())
            _repack(source, target, {name.removesuffix(".npy"): _changed(archive.read(name), chance)})
    else:
        target.write_bytes(_changed(source.read_bytes(), chance))
    return target


def _changed(data: bytes, chance: random.Random) -> bytes:
    for _ in range(chance.choice((1, 1, 2, 8))):
        data = chance.choice(_CHANGES)(data, chance) if data else b"\0"
    return data


def _flip(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data))
    return data[:at] + bytes([data[at] ^ 1 << chance.randrange(8)]) + data[at + 1 :]


def _overwrite(data: bytes, chance: random.Random) -> bytes:
    """A number that is on the edge of something, of one to eight bytes, near the file's head by preference."""
    size = chance.choice((1, 2, 4, 4, 8))
    value = chance.choice(
        (0, 1, 2 ** (8 * size) - 1, 2 ** (8 * size - 1), 2 ** (8 * size - 1) - 1, chance.getrandbits(8 * size))
    )
    at = chance.randrange(min(len(data), chance.choice((64, 1024, len(data)))) or 1)
    return data[:at] + value.to_bytes(size, chance.choice(("little", "big"))) + data[at + size :]


def _cut(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data))]


def _splice(data: bytes, chance: random.Random) -> bytes:
    """Copy a piece over, or into, another place."""
    start, at, size = chance.randrange(len(data)), chance.randrange(len(data)), chance.randint(1, 64)
    return data[:at] + data[start : start + size] + data[at + chance.choice((0, size)) :]


def _renumber(data: bytes, chance: random.Random) -> bytes:
    """Put another value in the place of a number of a text."""
    found = list(re.finditer(rb"-?\d+(\.\d+)?", data[:20_000]))
    if not found:
        return _overwrite(data, chance)
    one = chance.choice(found)
    return data[: one.start()] + chance.choice(_NUMBERS).encode() + data[one.end() :]


_CHANGES = (_flip, _overwrite, _overwrite, _cut, _splice, _renumber, _renumber)


def npy_header(text: str) -> bytes:
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def npy_claim(shape: str, descr: str = "<c8") -> bytes:
    return npy_header(f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n")


def _npy(values: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def _picture(values: NDArray[Any], kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(values).save(file, kind, **options)
    return file.getvalue()


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _png_head(wide: int, high: int, packed: bytes = b"x\x9c") -> bytes:
    head = struct.pack(">IIBBBBB", wide, high, 8, 0, 0, 0, 0)
    density = _png_chunk(b"pHYs", struct.pack(">IIB", 40_000, 40_000, 1))
    return (
        b"\x89PNG\r\n\x1a\n"
        + _png_chunk(b"IHDR", head)
        + density
        + _png_chunk(b"IDAT", packed)
        + _png_chunk(b"IEND", b"")
    )


def _png_zeros(wide: int, high: int) -> bytes:
    packer = zlib.compressobj(1)
    packed = b"".join([packer.compress(bytes(1 + wide) * 100) for _ in range(high // 100)])
    return _png_head(wide, high, packed + packer.flush())


def _tiff(values: NDArray[Any], **options: Any) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, values, metadata=None, photometric="minisblack", **options)
    return file.getvalue()


def _with_tags(data: bytes, tags: Mapping[int, int]) -> bytes:
    """A little-endian TIFF with other numbers in its first folder, each as a LONG."""
    made = bytearray(data)
    (at,) = struct.unpack_from("<I", made, 4)
    (count,) = struct.unpack_from("<H", made, at)
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        (code,) = struct.unpack_from("<H", made, entry)
        if code in tags:
            struct.pack_into("<HII", made, entry + 2, 4, 1, tags[code])
    return bytes(made)


def _tiff_bomb(small: bytes) -> bytes:
    """A strip of a few pixels that unpacks to 60 MB."""
    packed = zlib.compress(bytes(60_000_000), 1)
    return _with_tags(small, {259: 8, 273: len(small), 279: len(packed), 278: 2**16}) + packed


def _lfp_part(data: bytes) -> bytes:
    return b"\x89LFC\r\n\x1a\n\0\0\0\0" + struct.pack(">I", len(data)) + b"sha1-x".ljust(80, b"\0") + data


def _zarr_array(shape: list[int], chunk: list[int]) -> str:
    codecs = [
        {"name": "bytes", "configuration": {"endian": "little"}},
        {"name": "zstd", "configuration": {"level": 0, "checksum": False}},
    ]
    return json.dumps({
        "zarr_format": 3, "node_type": "array", "shape": shape, "data_type": "complex64", "fill_value": [0.0, 0.0],
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}}, "attributes": {},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}}, "codecs": codecs,
    })  # fmt: skip


def _message(dtype: str, shape: list[int], body: bytes) -> bytes:
    header = {"seq": 1, "arrays": [{"name": "slices", "dtype": dtype, "shape": shape, "unit": "1"}]}
    return json.dumps(header).encode() + b"\n" + body


def _request(method: str, path: str, body: str = "", *, length: str = "", chunked: bool = False) -> bytes:
    size = "transfer-encoding: chunked\r\n" if chunked else ""
    return (
        f"{method} {path} HTTP/1.1\r\nhost: 127.0.0.1\r\norigin: http://127.0.0.1\r\nconnection: close\r\n"
        f"content-type: application/json\r\ncontent-length: {length or len(body)}\r\n{size}\r\n{body}"
    ).encode()


def _flight(flights: Path) -> Path:
    """A closed flight of two frames, one of which was removed after its copy was proved."""
    clock = RecordedClock(10**18)
    flight = recording.begin(flights, clock)
    for number in range(2):
        makers.request(flight, number)
        flight.ledger.add_tag(makers.tag(makers.deliver(flight, number, b"raw" * 100)))
        flight.note_image(number)
    flight.telemetry.append(1, makers.mavlink_2(b"a"))
    flight.close()
    path = flight.folder.path
    line = b'{"destination":"/d","name":"frames/000001.cr2","sha256":"%s","size":300,"utc_ns":1}\n' % (b"0" * 64)
    (path / "offloaded.jsonl").write_bytes(line)
    with seals.reopened(flight.folder, clock, seals.Occasion.GEOTAG), Ledger(flight.folder.ledger, clock) as ledger:
        sha256 = hashlib.sha256(line).hexdigest()
        removed = finding(Code.FLIGHT_FILES_REMOVED, Subject("flight"), files=1, which="", there="", sha256=sha256)
        ledger.add_event("offloaded", removed)
    return path


def _telemetry() -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    found = b""
    for number in range(20):
        message = mavlink.MAVLink_global_position_int_message(number * 100, 416000000, -915000000, 1000, 50, 1, 2, 3, 4)
        found += (1_700_000_000_000_000 + number * 100_000).to_bytes(8, "big") + message.pack(sender)
    return found


def _repack(source: Path, target: Path, members: Mapping[str, bytes]) -> None:
    """Copy an NPZ with these members in place of its own."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as new:
        kept = {name: old.read(name) for name in old.namelist()}
        for name, data in {**kept, **{f"{name}.npy": data for name, data in members.items()}}.items():
            new.writestr(name, data)


def _raster(path: Path) -> Path:
    """Heights around the place that tests/bounds/doors.py looks at."""
    place = rasterio.Affine(5, 0, 620_000 - 300, 0, -5, 4_610_000 + 300)
    with rasterio.open(
        path, "w", driver="GTiff", width=120, height=120, count=1, dtype="float32", crs="EPSG:32615", transform=place
    ) as target:
        target.write(np.random.default_rng(2).random((1, 120, 120)).astype(np.float32))
    return path


def _calibration() -> Calibration:
    mask = profiles.mask("reference-5x5").mask
    sensor = profiles.camera("reference-36mm").raw[0].sensor
    lattice = Lattice((0.2, 0.0), (0.0, 0.2))
    transfer = (1.0,) * len(mask.half_orders())
    fit = LatticeFit(50.0, 8.0, lattice, 0.0, 1.0, True, (0.0, 0.0), transfer, 0.1, 0.1, 5)
    return Calibration(sensor.shape, "geometric", mask, sensor, (fit,))
