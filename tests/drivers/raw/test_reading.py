from __future__ import annotations

import io
import mmap
import tracemalloc
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from dappled.drivers.raw import raw_file, reading
from dappled.drivers.raw.reading import read, read_metadata
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, finding, text

RGGB, BGGR = bytes((0, 1, 1, 2)), bytes((2, 1, 1, 0))
RATIONAL = 5


def mosaic(shape: tuple[int, int] = (48, 64)) -> NDArray[np.uint16]:
    return np.random.default_rng(3).integers(300, 4000, shape).astype(np.uint16)


def dng(values: NDArray[np.uint16], pattern: bytes | None = RGGB, **more: Any) -> bytes:
    """A small DNG; `more` are extra tags (code, type, count, value) by name."""
    tags: list[tuple[int, int, int, Any, bool]] = [
        (50706, 1, 4, b"\x01\x04\x00\x00", True),  # DNGVersion
        (50708, 2, 0, "Test Body", True),  # UniqueCameraModel
        (271, 2, 0, "dappled", True),
        (272, 2, 0, "Test Body", True),
        (50714, 4, 1, 256, True),  # BlackLevel
        (50717, 4, 1, 4095, True),  # WhiteLevel
        (50721, 10, 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),  # ColorMatrix1
        *((code, kind, count, value, True) for code, kind, count, value in more.values()),
    ]
    if pattern is not None:
        tags += [(33421, 3, 2, (2, 2), True), (33422, 1, 4, pattern, True)]
        tags += [(50728, RATIONAL, 3, (1, 2, 1, 1, 2, 3), True)]  # AsShotNeutral
    file = io.BytesIO()
    tifffile.imwrite(file, values, photometric=32803 if pattern else 34892, extratags=tags, metadata=None)
    return file.getvalue()


@pytest.mark.parametrize(("pattern", "cfa"), [(RGGB, [[0, 1], [3, 2]]), (BGGR, [[2, 3], [1, 0]])])
def test_a_dng_gives_its_values_and_what_they_mean(pattern: bytes, cfa: list[list[int]]) -> None:
    values = mosaic()
    frame = read(dng(values, pattern), "a.dng")
    np.testing.assert_array_equal(frame.mosaic, values)
    assert frame.mosaic.flags.owndata
    assert (frame.black, frame.white) == (256.0, 4095.0)
    names = np.array(frame.colour_names)
    assert frame.cfa is not None
    np.testing.assert_array_equal(names[frame.cfa], names[np.array(cfa)])
    assert frame.balance == pytest.approx((2.0, 1.0, 1.5, 1.0)[: len(frame.balance or ())])
    assert (frame.make, frame.model) == ("dappled", "Test Body")
    assert (frame.focal_length_mm, frame.f_number, frame.taken) == (None, None, None)


@pytest.mark.parametrize("name", ["a.dng", "a.tif", "whatever"])
def test_the_bytes_decide_not_the_name(name: str) -> None:
    assert read(dng(mosaic()), name).cfa is not None


def test_exposure_is_read_from_exif() -> None:
    file = dng(
        mosaic(),
        focal=(37386, RATIONAL, 1, (148, 10)),
        f_number=(33437, RATIONAL, 1, (56, 10)),
        exposure=(33434, RATIONAL, 1, (1, 2000)),
        iso=(34855, 3, 1, 400),
        taken=(36867, 2, 0, "2026:11:21 10:15:03"),
    )
    frame = read(file)
    assert (frame.focal_length_mm, frame.f_number, frame.exposure_s, frame.iso) == (14.8, 5.6, 0.0005, 400.0)
    assert frame.taken == "2026-11-21T10:15:03"
    told = read_metadata(file)
    assert (told.focal_length_mm, told.taken, told.make) == (14.8, "2026-11-21T10:15:03", "dappled")


@pytest.mark.parametrize(
    ("written", "sigma_mm"), [((33, 1), 0.5), ((148, 10), 0.05), ((14800, 1000), 0.05), ((0, 1), None)]
)
def test_a_focal_length_is_known_to_half_of_its_rounding(written: tuple[int, int], sigma_mm: float | None) -> None:
    file = dng(mosaic(), focal=(37386, RATIONAL, 1, written))
    assert read(file).focal_sigma_mm == sigma_mm
    assert read_metadata(file).focal_sigma_mm == sigma_mm


def test_zero_in_exif_is_unknown() -> None:
    file = dng(
        mosaic(),
        focal=(37386, RATIONAL, 1, (0, 1)),
        f_number=(33437, RATIONAL, 1, (0, 0)),
        exposure=(33434, RATIONAL, 1, (0, 1)),
        iso=(34855, 3, 1, 0),
        taken=(36867, 2, 0, "0000:00:00 00:00:00"),
    )
    frame = read(file)
    assert (frame.focal_length_mm, frame.f_number, frame.exposure_s, frame.iso, frame.taken) == (None,) * 5


@pytest.mark.parametrize("value", [0, -1, float("nan"), float("inf"), None, "x", b"", (), [], object()])
def test_only_numbers_above_zero_are_known(value: object) -> None:
    assert raw_file.positive(value) is None


def test_bytes_come_in_any_form(tmp_path: Path) -> None:
    data = dng(values := mosaic())
    path = tmp_path / "a.dng"
    path.write_bytes(data)
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ) as mapped:
        for source in (path, str(path), data, memoryview(data), mapped):
            np.testing.assert_array_equal(read(source).mosaic, values)


def test_levels_are_plain_values_in_the_places_of_the_pattern() -> None:
    raw = replace(read(dng(mosaic())), black=(1.0, 2.0, 3.0, 4.0), white=100.0)
    assert raw.levels() == {"cfa": ["RG", "GB"], "black": [[1.0, 2.0], [4.0, 3.0]], "white_level": 100.0}
    grey = replace(raw, cfa=None, colour_names=(), black=7.0)
    assert grey.levels() == {"cfa": None, "black": [[7.0]], "white_level": 100.0}


def png(values: NDArray[Any], **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(values).save(file, "PNG", **options)
    return file.getvalue()


def tiff(values: NDArray[Any], **options: Any) -> bytes:
    file = io.BytesIO()
    tifffile.imwrite(file, values, **options)
    return file.getvalue()


def npy(values: NDArray[Any]) -> bytes:
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


@pytest.mark.parametrize(("kind", "name"), [(png, "a.png"), (tiff, "a.tif"), (npy, "a.npy")])
@pytest.mark.parametrize("depth", [np.uint8, np.uint16])
def test_a_grey_picture_gives_its_values(
    kind: Callable[..., bytes], name: str, depth: type[np.unsignedinteger[Any]]
) -> None:
    values = (mosaic() % 256 if depth is np.uint8 else mosaic() * 16).astype(depth)
    frame = read(kind(values), name)
    assert frame.mosaic.dtype == depth
    np.testing.assert_array_equal(frame.mosaic, values)
    assert (frame.black, frame.white, frame.cfa) == (0.0, np.iinfo(depth).max, None)
    assert (frame.colour_names, frame.balance, frame.make) == (("W",), None, None)
    assert read_metadata(kind(values), name).make is None


@pytest.mark.parametrize(("kind", "name"), [(png, "a.png"), (tiff, "a.tif"), (npy, "a.npy")])
def test_colour_becomes_the_mean_of_a_bayer_cell(kind: Callable[..., bytes], name: str) -> None:
    values = np.random.default_rng(1).integers(0, 256, (6, 8, 3)).astype(np.uint8)
    frame = read(kind(values), name)
    np.testing.assert_allclose(frame.mosaic, values @ np.array([0.25, 0.5, 0.25]))
    assert frame.white == 255.0


def test_transparency_and_palettes_are_left_behind() -> None:
    values = np.random.default_rng(1).integers(0, 256, (6, 8, 4)).astype(np.uint8)
    np.testing.assert_allclose(read(png(values)).mosaic, values[..., :3] @ np.array([0.25, 0.5, 0.25]))
    file = io.BytesIO()
    Image.fromarray(values[..., 0]).convert("P").save(file, "PNG")
    np.testing.assert_array_equal(read(file.getvalue()).mosaic, values[..., 0])


def test_floats_reach_to_one() -> None:
    frame = read(npy(np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)))
    assert frame.white == 1.0
    assert frame.mosaic.dtype == np.float32


def test_a_tiff_may_say_its_white() -> None:
    values = mosaic()
    assert read(tiff(values, extratags=[(281, 3, 1, 4095, True)]), "a.tif").white == 4095.0


def test_a_jpeg_gives_values_and_exif() -> None:
    image = Image.fromarray(np.full((16, 24), 100, np.uint8))
    details = Image.Exif()
    details[0x010F] = "Canon\0 "
    details.get_ifd(0x8769)[0x920A] = 100.0
    file = io.BytesIO()
    image.save(file, "JPEG", exif=details)
    frame = read(file.getvalue())
    assert abs(int(frame.mosaic[3, 3]) - 100) <= 2
    assert (frame.make, frame.focal_length_mm, frame.developed) == ("Canon", 100.0, finding(Code.TONES_JPEG, FRAME))


def with_chunk(name: bytes, data: bytes) -> bytes:
    chunk = PngInfo()
    chunk.add(name, data)
    return png(np.full((16, 24), 100, np.uint8), pnginfo=chunk)


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (png(np.full((16, 24), 100, np.uint8)), ""),
        (with_chunk(b"gAMA", (100_000).to_bytes(4, "big")), ""),
        (with_chunk(b"gAMA", bytes(4)), ""),
        (with_chunk(b"gAMA", (45_455).to_bytes(4, "big")), "its gAMA chunk says that its values have a gamma of 1/2.2"),
        (with_chunk(b"sRGB", b"\0"), "its sRGB chunk says that it was developed"),
    ],
)
def test_a_png_may_say_that_its_values_are_not_linear(data: bytes, told: str) -> None:
    found = read(data).developed
    assert ("" if found is None else str(text(found))) == told


def test_a_jpeg_of_four_colours_is_a_jpeg() -> None:
    file = io.BytesIO()
    Image.new("CMYK", (24, 16), (10, 20, 30, 40)).save(file, "JPEG")
    assert read(file.getvalue()).developed == finding(Code.TONES_JPEG, FRAME)


@pytest.mark.parametrize("kind", [">u2", "i2", "i4", "u4", "i8"])
def test_integers_of_any_size_and_byte_order_are_those_of_16_bits(kind: str) -> None:
    values = np.arange(12).reshape(3, 4) * 100
    frame = read(npy(values.astype(kind)))
    assert frame.mosaic.dtype == np.uint16
    assert frame.white == 65535
    np.testing.assert_array_equal(frame.mosaic, values)


@pytest.mark.parametrize("kind", ["f2", ">f4", ">f8", "longdouble"])
def test_floats_of_any_size_and_byte_order_are_read(kind: str) -> None:
    values = np.linspace(0, 1, 12).reshape(3, 4)
    frame = read(npy(values.astype(kind)))
    assert frame.white == 1
    np.testing.assert_allclose(frame.mosaic, values, atol=5e-4)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is empty"),
        (b"hello, this is text", "a.dng"),
        (dng(mosaic())[:40], "a.dng"),
        (dng(mosaic())[:-2000], "a.dng"),
        (png(mosaic())[:200], "damaged or cut short"),
        (png(mosaic())[:20], "a.dng"),
        (b"\x89PNG\r\n\x1a\n", "not a frame"),
        (b"\xff\xd8\xff\xe0" + bytes(50), "not a frame"),
        (b"\x93NUMPY1234567890", "damaged or cut short"),
        (npy(np.full((3, 4), 70000)), "70000 to 70000; a frame has 8 or 16 bits"),
        (npy(np.full((3, 4), -1)), "8 or 16 bits"),
        (npy(np.zeros((3, 4), complex)), "a.dng can't be read as a frame: its values are complex128"),
        (npy(np.zeros(7, np.uint8)), "its shape is"),
        (npy(np.zeros((0, 7), np.uint8)), "its shape is"),
        (npy(np.array([{}], dtype=object)), "can't be read"),
        (b"II*\0" + bytes(100), "a.dng"),
    ],
)
def test_what_is_no_frame_is_told_with_its_name(data: bytes, words: str) -> None:
    with pytest.raises(DappledError, match=words) as told:
        read(data, "a.dng")
    assert "a.dng" in str(told.value)
    assert "\n" not in str(told.value)


def test_a_deep_colour_png_is_refused_not_cut() -> None:
    data = bytearray(png(np.zeros((4, 4, 3), np.uint8)))
    header = data[12:24] + bytes((16, 2)) + data[26:29]
    data[12:29] = header
    data[29:33] = zlib.crc32(header).to_bytes(4, "big")
    with pytest.raises(DappledError, match="colour PNG of 16 bits"):
        read(bytes(data))


def test_paths_that_lead_nowhere_are_told(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.dng", tmp_path):
        for ask in (read, read_metadata):
            with pytest.raises(DappledError, match=str(path)):
                ask(path)


@given(
    st.binary(max_size=300),
    st.sampled_from(
        [b"", b"II*\0", b"MM\0*", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"\x93NUMPY", b"FUJIFILMCCD-RAW "]
    ),
)
def test_any_bytes_give_a_frame_or_a_sentence(data: bytes, start: bytes) -> None:
    for ask in (read, read_metadata):
        with suppress(DappledError):
            ask(start + data, "a.tif")


@pytest.mark.parametrize(
    ("name", "model", "lens", "shape", "colours"),
    [
        ("synthetic_450D.CR2", "Canon EOS 450D", (146.0, 5.6), (2856, 4290), "RG/GB"),
        ("synthetic_S5200.RAF", "FinePix S5200", (14.8, 6.4), (2918, 1852), "RB/GG/BR/GG"),
    ],
)
def test_files_of_the_two_bodies(
    *, shared_data: Path, name: str, model: str, lens: tuple[float, float], shape: tuple[int, int], colours: str
) -> None:
    path = shared_data / "raw" / name
    frame = read(path)
    assert frame.mosaic.shape == shape
    assert frame.mosaic.dtype == np.uint16
    assert (frame.model, frame.focal_length_mm, frame.f_number) == (model, *lens)
    assert frame.taken == "2026-11-21T10:00:00"
    assert frame.cfa is not None
    assert "/".join("".join(frame.colour_names[i] for i in row) for row in frame.cfa) == colours
    told = read_metadata(path)
    assert (told.model, told.focal_length_mm) == (model, lens[0])
    with pytest.raises(DappledError, match=name):
        read(path.read_bytes()[: path.stat().st_size // 2], name)


def test_real_photographs_say_their_focal_length(shared_data: Path) -> None:
    for name, make, focal_length_mm in (
        ("real_Canon_EOS_450D.jpg", "Canon", 100.0),
        ("real_FujiFilm_FinePixS5500.jpg", "FUJIFILM", 7.5),
    ):
        told = read_metadata(shared_data / "raw" / name)
        assert (told.make, told.focal_length_mm) == (make, focal_length_mm)


def test_a_real_body_says_how_warm_it_was(shared_data: Path) -> None:
    """exiftool says 24 °C of this one."""
    assert read_metadata(shared_data / "raw" / "real_Canon_EOS_450D.jpg").temperature_c == 24.0
    assert read_metadata(shared_data / "raw" / "real_FujiFilm_FinePixS5500.jpg").temperature_c is None


def test_a_lenslet_photograph(shared_data: Path) -> None:
    frame = reading.read(shared_data / "lenslet" / "ulf_letters" / "letters_ULF_M1.png")
    assert frame.mosaic.shape == (960, 1280)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["tif", "png"])
def test_a_frame_of_200_megapixels_is_read(tmp_path: Path, kind: str) -> None:
    """Pillow's own limit is 179."""
    values = np.random.default_rng(1).integers(0, 255, (12_000, 17_000), dtype=np.uint8)
    path = tmp_path / f"a.{kind}"
    if kind == "tif":
        tifffile.imwrite(path, values)
    else:
        Image.fromarray(values).save(path, compress_level=0)
    np.testing.assert_array_equal(read(path).mosaic, values)
    read_metadata(path)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_pixels_that_are_not_stored_are_not_unpacked(name: str) -> None:
    values = np.zeros((9000, 9000), np.uint8)
    file = io.BytesIO()
    if name == "a.png":
        Image.fromarray(values).save(file, "PNG", compress_level=1)
    else:
        tifffile.imwrite(file, values, compression="zlib")
    with pytest.raises(DappledError, match=r"its 9000 × 9000 pixels would take 81 MB of memory, and the .* stored"):
        read(file.getvalue(), name)


def test_an_error_does_not_hold_the_file(tmp_path: Path) -> None:
    """Errors are kept for a while, in cycles until the collector comes by: ten frames of 11 MB were."""
    path = tmp_path / "a.cr2"
    path.write_bytes(bytes(range(256)) * 40_000)
    tracemalloc.start()
    try:
        with pytest.raises(DappledError) as kept:
            read_metadata(path)
        held, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert "is not a frame that can be read" in str(kept.value)
    assert most > 10_000_000
    assert held < 1_000_000
