from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.drivers.raw import lytro, reading
from dappled.errors import DappledError
from tests.simulated.lytro import container, metadata, packed

SHAPE = (12, 16)


@dataclass(frozen=True)
class Kind:
    """A camera, and how it packs its pixels."""

    model: str
    shape: tuple[int, int]
    bits: int
    endianness: str
    pattern: str
    black: int


def _values(bits: int, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 2**bits, shape).astype(np.uint16)


@pytest.mark.parametrize("bits", [10, 12, 16])
@pytest.mark.parametrize("endianness", ["big", "little"])
def test_pixels_are_unpacked_as_they_were_packed(bits: int, endianness: str) -> None:
    values = _values(bits)
    found = lytro.unpacked(packed(values, bits, endianness), values.size, bits, endianness)
    np.testing.assert_array_equal(found, values.reshape(-1))


def test_the_cameras_own_packing() -> None:
    """Twelve bits, high ones first; ten bits, four high bytes and their low pairs, the first pixel's lowest."""
    assert lytro.unpacked(bytes((0xAB, 0xCD, 0xEF)), 2, 12, "big").tolist() == [0xABC, 0xDEF]
    assert lytro.unpacked(bytes((1, 2, 3, 4, 0b11_10_01_00)), 4, 10, "little").tolist() == [4, 9, 14, 19]


FIRST = Kind("F01", (3280, 3280), 12, "big", "bggr", 168)
ILLUM = Kind("ILLUM", (5368, 7728), 10, "little", "grbg", 64)


@pytest.mark.parametrize("kind", [FIRST, ILLUM])
def test_a_container_comes_through_the_same_door_as_other_raws(kind: Kind, tmp_path: Path) -> None:
    values = _values(kind.bits)
    first = kind is FIRST
    told = metadata(
        SHAPE, model=kind.model, bits=kind.bits, endianness=kind.endianness, pattern=kind.pattern, nested=first
    )
    path = tmp_path / "frame.lfp"
    path.write_bytes(container(values, told, frames_key="picture" if first else "frames"))
    frame = reading.read(path)
    np.testing.assert_array_equal(frame.mosaic, values)
    assert (frame.black, frame.white) == (168, 2**kind.bits - 1)
    assert frame.cfa is not None
    assert "".join(frame.colour_names[i] for i in frame.cfa.flat) == kind.pattern.upper()
    assert (frame.make, frame.model) == ("Lytro, Inc.", kind.model)
    assert (frame.focal_length_mm, frame.f_number, frame.exposure_s, frame.iso) == (6.45, 2.0, 0.004, 80)
    assert frame.taken == "2013-05-04T10:11:12.000"
    assert frame.balance == (1.4, 1.0, 1.2, 1.0)
    assert reading.read_metadata(path).model == kind.model


def test_bare_pixels_are_known_by_their_size_or_by_what_lies_beside_them(tmp_path: Path) -> None:
    values = _values(12)
    path = tmp_path / "MOD_0001.RAW"
    path.write_bytes(packed(values, 12, "big"))
    with pytest.raises(DappledError, match="MOD_0001"):
        reading.read(path)
    wrapped = {"master": {"picture": {"frameArray": [{"frame": {"metadata": metadata(SHAPE)}}]}}}
    path.with_suffix(".TXT").write_text(json.dumps(wrapped))
    np.testing.assert_array_equal(reading.read(path).mosaic, values)
    assert reading.read_metadata(path).focal_length_mm == 6.45
    path.with_suffix(".TXT").write_text("no JSON")
    with pytest.raises(DappledError, match="MOD_0001"):
        reading.read(path)


@pytest.mark.parametrize("kind", [FIRST, pytest.param(ILLUM, marks=pytest.mark.slow)])  # of 41 megapixels
def test_both_cameras_bare_files(kind: Kind, tmp_path: Path) -> None:
    values = _values(kind.bits, kind.shape)
    path = tmp_path / "frame.raw"
    path.write_bytes(packed(values, kind.bits, kind.endianness))
    frame = reading.read(path)
    np.testing.assert_array_equal(frame.mosaic, values)
    assert frame.cfa is not None
    assert "".join(frame.colour_names[i] for i in frame.cfa.flat) == kind.pattern.upper()
    assert (frame.black, frame.white) == (kind.black, 2**kind.bits - 1)


def test_a_stack_of_finished_pictures_is_no_frame() -> None:
    whole = container(_values(12), metadata(SHAPE)).replace(b"imageRef", b"imageXef")
    with pytest.raises(DappledError, match="only finished pictures"):
        reading.read(whole, "a-stk.lfp")


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_file_cut_short_is_told(share: float) -> None:
    whole = container(_values(12, (64, 64)), metadata((64, 64)))
    with pytest.raises(DappledError, match=r"a\.lfp"):
        reading.read(whole[: int(share * len(whole))], "a.lfp")


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"bitsPerPixel": 12', b'"bitsPerPixel": 13'),
        (b'"upperLeftPixel": "b"', b'"upperLeftPixel": "w"'),
        (b'"width": 16', b'"width": -6'),
        (b'"width": 16', b'"width": 99'),
        (b'"endianness": "big"', b'"endianness": "odd"'),
        (b'"black": {"r": 168', b'"black": {"r": "1"'),
        (b'"pixelFormat"', b'"pixelFormXt"'),
    ],
)
def test_metadata_that_makes_no_sense_is_told_in_a_sentence(old: bytes, new: bytes) -> None:
    whole = container(_values(12), metadata(SHAPE))
    assert old in whole
    with pytest.raises(DappledError) as told:
        reading.read(whole.replace(old, new), "a.lfp")
    assert "a.lfp" in str(told.value)
    assert "\n" not in str(told.value)


@given(st.data())
def test_any_damage_gives_a_frame_or_a_sentence(data: st.DataObject) -> None:
    whole = bytearray(container(_values(12), metadata(SHAPE)))
    for _ in range(data.draw(st.integers(1, 6))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    whole = whole[: data.draw(st.integers(8, len(whole)))]
    with suppress(DappledError):
        reading.read(bytes(whole), "a.lfp")


@given(st.binary(max_size=200))
def test_any_bytes_after_the_beginning_give_a_sentence(data: bytes) -> None:
    with pytest.raises(DappledError):
        reading.read(lytro.START + data, "a.lfp")
