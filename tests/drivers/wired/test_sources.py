"""Sources of files: folders, mass storage, a camera in PTP mode."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

import pytest

from dappled.drivers.camera import CameraError
from dappled.drivers.gphoto2.client import open_camera
from dappled.drivers.wired.ptp_source import PtpSource
from dappled.drivers.wired.sources import FileSource, FolderSource, FoundFile, StorageSource, groups, parse_source
from dappled.mocks.body.body import BodyOptions, SimulatedBody, pattern
from dappled.testing import content, until_shot_ends, until_state
from tests.simulated.finepix import FinePix, picture


def read(source: FileSource, found: FoundFile) -> bytes:
    blob = source.open(found)
    data = os.pread(blob.fd, blob.size, 0)
    blob.close()
    return data


def test_a_folder_lists_pictures_only_in_order(tmp_path: Path) -> None:
    for name in ("b/DSCF0002.RAF", "a/DSCF0001.raf", ".trash/x.raf", "notes.txt", ".DSCF0003.RAF", "c.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(name.encode())
    source = FolderSource(tmp_path)
    found = source.list()
    assert [one.name for one in found] == ["a/DSCF0001.raf", "b/DSCF0002.RAF", "c.jpg"]
    assert (found[1].base, found[1].stem, found[1].raw, found[2].raw) == ("DSCF0002.RAF", "b/DSCF0002", True, False)
    assert read(source, found[1]) == b"b/DSCF0002.RAF"
    assert source.taken_s(found[0]) is None
    source.close()


def test_a_folder_s_files_tell_their_times(tmp_path: Path) -> None:
    (tmp_path / "x.RAF").write_bytes(picture(1, 6.3, 1_700_000_000))
    source = FolderSource(tmp_path)
    assert source.taken_s(source.list()[0]) == 1_700_000_000


def test_what_is_gone_is_a_sentence(tmp_path: Path) -> None:
    source = FolderSource(tmp_path / "none")
    with pytest.raises(CameraError, match="none is not there"):
        source.list()
    for ask in (source.open, source.taken_s):
        with pytest.raises(CameraError, match=r"x\.raf can't be read"):
            ask(FoundFile("x.raf", 1))


def test_mass_storage_is_found_where_it_is_mounted(tmp_path: Path) -> None:
    body = FinePix(tmp_path)
    source = StorageSource(body.mounts, body.places)
    with pytest.raises(CameraError, match="mass storage"):
        source.list()
    (body.card / "DCIM" / "100_FUJI" / "DSCF0001.RAF").write_bytes(b"one")
    body.plug()
    assert [one.name for one in source.list()] == ["100_FUJI/DSCF0001.RAF"]
    body.unplug()
    with pytest.raises(CameraError, match="mass storage"):
        source.list()


def test_of_two_cards_the_one_that_was_read_before_counts_and_else_none(tmp_path: Path) -> None:
    body = FinePix(tmp_path)
    other = tmp_path / "media" / "OTHER"
    (other / "DCIM").mkdir(parents=True)
    (other / "DCIM" / "IMG_0001.CR2").write_bytes(b"of another camera")
    (body.card / "DCIM" / "100_FUJI" / "DSCF0001.RAF").write_bytes(b"one")
    body.plug()
    both = f"/dev/sdc1 {other} vfat rw 0 0\n{body.mounts.read_text()}"
    source = StorageSource(body.mounts, body.places)
    assert [one.base for one in source.list()] == ["DSCF0001.RAF"]
    body.mounts.write_text(both)
    assert [one.base for one in source.list()] == ["DSCF0001.RAF"]
    with pytest.raises(CameraError, match=r"2 cards are mounted, .*OTHER and .*FINEPIX: unmount all but one"):
        StorageSource(body.mounts, body.places).list()


def test_a_mount_that_can_t_be_read_is_a_sentence_and_hides_no_other(tmp_path: Path) -> None:
    body = FinePix(tmp_path)
    (body.card / "DCIM" / "100_FUJI" / "DSCF0001.RAF").write_bytes(b"one")
    source = StorageSource(body.mounts, body.places)
    bad = f"/dev/sda1 {tmp_path}/media/{'x' * 300} vfat rw 0 0\nno mount\n"  # a name too long: looking raises OSError
    body.mounts.write_text(bad)
    with pytest.raises(CameraError, match="can't be read: File name too long"):
        source.list()
    body.plug()
    body.mounts.write_text(bad + body.mounts.read_text())
    assert [one.name for one in source.list()] == ["100_FUJI/DSCF0001.RAF"]
    body.mounts.unlink()
    with pytest.raises(CameraError, match="mounts can't be read: No such file"):
        source.list()


def test_a_card_that_is_pulled_while_it_is_listed_is_not_an_empty_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "1.RAF").write_bytes(b"one")
    scan = os.scandir

    def pulled(path: str, number: int) -> Any:
        if str(path).endswith("/a"):
            raise OSError(number, os.strerror(number), str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", lambda path: pulled(path, errno.EIO))
    with pytest.raises(CameraError, match="Input/output error"):
        FolderSource(tmp_path).list()
    monkeypatch.setattr(os, "scandir", lambda path: pulled(path, errno.EACCES))
    assert FolderSource(tmp_path).list() == []  # a folder in it is not ours
    with pytest.raises(CameraError, match="Permission denied"):
        FolderSource(tmp_path / "a").list()


def test_one_exposure_s_files_are_a_group() -> None:
    found = [FoundFile("a/1.JPG", 1), FoundFile("a/1.RAF", 1), FoundFile("a/2.RAF", 1), FoundFile("b/1.JPG", 1)]
    made = groups(found)
    assert [(one.main.name, [other.name for other in one.companions]) for one in made] == [
        ("a/1.RAF", ["a/1.JPG"]), ("a/2.RAF", []), ("b/1.JPG", []),
    ]  # fmt: skip


def test_sources_by_name(tmp_path: Path) -> None:
    assert isinstance(parse_source("storage", PtpSource), StorageSource)
    assert isinstance(parse_source("usb:", PtpSource), PtpSource)
    for text in (str(tmp_path), f"folder:{tmp_path}"):
        source = parse_source(text, PtpSource)
        assert isinstance(source, FolderSource)
        assert source.folder == tmp_path


def test_a_camera_in_ptp_mode_lists_and_sends_its_card() -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:300001:cr2", pairs=True)) as body:
        camera = open_camera({"port": body.port})
        camera.start()
        until_state(camera, "ready")
        for shot in (1, 2):
            camera.fire(shot)
            content(until_shot_ends(camera, shot)[-1])  # type: ignore[arg-type]  # an Arrival, or the test fails there
        camera.stop()
        source = PtpSource(body.port)
        try:
            found = source.list()
            assert [one.base for one in found] == ["IMG_0001.CR2", "IMG_0001.JPG", "IMG_0002.CR2", "IMG_0002.JPG"]
            assert found[0].size == 300_001
            assert read(source, found[2]) == pattern(2, 300_001)
            assert source.taken_s(found[0]) is not None
            body.fault("unplug")
            with pytest.raises(CameraError, match="camera"):
                source.open(found[0])
            body.fault("clear")
            assert len(source.list()) == 4
        finally:
            source.close()


def test_no_camera_in_ptp_mode_is_a_sentence() -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:1000:cr2")) as gone:
        port = gone.port
    source = PtpSource(port)
    with pytest.raises(CameraError, match="no camera answers"):
        source.list()
    source.close()
    source.close()
