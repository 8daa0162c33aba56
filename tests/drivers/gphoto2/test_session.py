"""What the simulated bodies don't do: files without bytes, very long names."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any

import gphoto2 as gp
import pytest

from dappled.drivers.gphoto2.protocol import CameraFile, RefusedError
from dappled.drivers.gphoto2.session import GPhoto2Session

FOLDER = "/store/DCIM/100CANON"


@dataclass
class Info:
    size: int
    fields: int = gp.GP_FILE_INFO_SIZE | gp.GP_FILE_INFO_MTIME
    mtime: int = 1_700_000_000


@dataclass
class Told:
    file: Info


@dataclass
class FakeLibrary:
    """The part of `gphoto2.Camera` that reading a file needs."""

    card: dict[str, bytes] = field(default_factory=dict)

    def get_single_config(self, name: str) -> Any:
        raise gp.GPhoto2Error(gp.GP_ERROR_BAD_PARAMETERS)

    def file_get_info(self, folder: str, name: str) -> Told:
        return Told(Info(len(self.card[name])))

    def file_read(self, folder: str, name: str, kind: int, offset: int, into: memoryview) -> int:
        piece = self.card[name][offset : offset + len(into)]
        into[: len(piece)] = piece
        return len(piece)


@pytest.fixture
def library() -> FakeLibrary:
    return FakeLibrary()


@pytest.fixture
def session(library: FakeLibrary) -> GPhoto2Session:
    return GPhoto2Session(library, "usb:1,2", "card")


def test_a_file_without_bytes_is_refused_in_a_sentence(library: FakeLibrary, session: GPhoto2Session) -> None:
    library.card["IMG_0001.CR2"] = b""
    with pytest.raises(RefusedError, match=r"announced 0 bytes of IMG_0001\.CR2"):
        session.fetch(CameraFile(FOLDER, "IMG_0001.CR2"))


@pytest.mark.parametrize("name", ["IMG_0001.CR2", "Ä" * 200 + ".CR2"])
def test_a_file_is_read_in_pieces_whatever_it_is_called(
    library: FakeLibrary, session: GPhoto2Session, name: str
) -> None:
    library.card[name] = bytes(range(256)) * 5000  # more than a piece
    fetched = session.fetch(CameraFile(FOLDER, name))
    assert os.pread(fetched.blob.fd, fetched.blob.size + 1, 0) == library.card[name]
    assert fetched.taken_s == 1_700_000_000
    fetched.blob.close()
