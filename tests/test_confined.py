"""Names from a ledger, an index, a manifest or a light field that lead out of their folder, at every door."""

from __future__ import annotations

import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from dappled import confined, durable
from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.confined import OutsideError
from dappled.daemon.camera_protocol import camera_status
from dappled.daemon.replay import replay, runs
from dappled.decode.lightfield import LightField
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError
from dappled.findings import Code
from dappled.flight import (
    FlightFolder,
    Frame,
    ImageIndex,
    Ledger,
    LedgerReader,
    layout,
    recording,
    recovery,
)
from dappled.flight.checks import flight_check
from dappled.products import opened
from dappled.products.batch.batch import BatchOutput, Done, Manifest
from dappled.products.exports import light_files
from dappled.products.geotags import geotags
from dappled.products.maps.laboratory import Laboratory
from dappled.products.mounting import Mounting
from dappled.products.opened import OpenedFlight
from tests.flight.conftest import START_UTC_NS
from tests.flight.makers import deliver, request, tag, words_of

SECRET = b"somebody else's file"


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    """A closed flight of two tagged frames and a stray; `victim.txt` stands beside it."""
    begun = recording.begin(tmp_path / "flights", RecordedClock(START_UTC_NS), {"settings": {}, "names": {}})
    for index in range(2):
        request(begun, index)
        begun.ledger.add_tag(tag(deliver(begun, index, b"raw %d" % index)))
    begun.close()
    (begun.folder.path.parent / "victim.txt").write_bytes(SECRET)
    return begun.folder.path


def edit(flight: Path, name: str, table: str = "frames") -> None:
    """Give the first file another name in the ledger, as an editor of SQLite would."""
    with closing(sqlite3.connect(flight / "flight.sqlite")) as ledger, ledger:
        ledger.execute("PRAGMA foreign_keys=OFF")
        if table == "strays":
            ledger.execute("INSERT INTO strays VALUES (?, 'A.CR2', 20, 'ab', 1, 'a stray')", (name,))
        else:
            ledger.execute("UPDATE frames SET name = ? WHERE idx = 0", (name,))


def listing(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.endswith(("-shm", "-wal"))
    }


@pytest.mark.parametrize(
    "name", ["../victim.txt", "/etc/passwd", "frames/../../victim.txt", "frames//a", "", ".", "a/."]
)
def test_a_name_that_leads_out_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutsideError, match=r"the ledger names .*, which does not stay inside .*: nothing was touched"):
        confined.path(tmp_path, name, "the ledger")


def test_a_link_is_not_followed_wherever_it_stands(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "a").write_bytes(b"")
    (tmp_path / "folder").symlink_to("real")
    (tmp_path / "real" / "b").symlink_to("a")
    assert confined.path(tmp_path, "real/a", "it") == tmp_path / "real" / "a"
    assert confined.path(tmp_path, "real/missing/a", "it") == tmp_path / "real" / "missing" / "a"
    for name, link in (("folder/a", "folder"), ("real/b", "real/b")):
        with pytest.raises(OutsideError, match=f"it holds '{name}', but {tmp_path}/{link} is a link"):
            confined.path(tmp_path, name, "it")


RECIPE = Recipe(camera="canon-eos-450d", mask="mask-1")
DOORS: dict[str, Callable[[Path, Path], object]] = {
    "geotag": lambda flight, out: geotags.write(flight, geotags.PlacedBy(Mounting())),
    "geotag elsewhere": lambda flight, out: geotags.write(flight, geotags.PlacedBy(Mounting()), output=out),
    "copies": lambda flight, out: list(geotags.copies(flight, out, geotags.PlacedBy(Mounting()))),
    "replay": lambda flight, out: replay.of_flight(flight),
    "open": lambda flight, out: list(cast(OpenedFlight, opened.open(flight, camera=RECIPE.camera, mask=RECIPE.mask))),
    "decode": lambda flight, out: Laboratory(RECIPE).frame(flight, _first(flight), None),
}


def _first(flight: Path) -> Frame:
    with LedgerReader.open(flight / "flight.sqlite") as ledger:
        return ledger.frames()[0]


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("name", ["../victim.txt", "/etc/hostname", "frames/../../victim.txt"])
def test_no_door_opens_a_name_that_leads_out_of_the_flight(flight: Path, tmp_path: Path, door: str, name: str) -> None:
    edit(flight, name)
    before = listing(flight.parent)
    with pytest.raises(OutsideError, match=f"flight.sqlite names {name!r}, which does not stay inside"):
        DOORS[door](flight, tmp_path / "out")
    assert listing(flight.parent) == before
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("linked", ["frames", "frames/000000.cr2"])
def test_no_door_follows_a_link(flight: Path, tmp_path: Path, door: str, linked: str) -> None:
    shutil.move(flight / linked, tmp_path / "elsewhere")
    (flight / linked).symlink_to(tmp_path / "elsewhere")
    before = listing(tmp_path)
    with pytest.raises(OutsideError, match=f"{linked} is a link: it is not followed"):
        DOORS[door](flight, tmp_path / "out")
    assert listing(tmp_path) == before


def test_geotag_says_which_name_in_which_file(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit(flight, "../victim.txt")
    assert main(["geotag", str(flight)]) == 1
    assert f"the ledger {flight}/flight.sqlite names '../victim.txt'" in capsys.readouterr().err
    assert not (flight.parent / "victim.txt.xmp").exists()


@pytest.mark.parametrize("folder", ["geotags", "frames"])
def test_geotag_writes_through_no_link(flight: Path, tmp_path: Path, folder: str) -> None:
    (tmp_path / "elsewhere").mkdir()
    if folder == "frames":
        victim = flight.parent / "victim.txt"
        (flight / "frames" / ".000000.cr2.xmp.part").symlink_to(victim)
        geotags.write(flight, geotags.PlacedBy(Mounting()))
        assert victim.read_bytes() == SECRET
        assert not (flight / "frames" / "000000.cr2.xmp").is_symlink()
    else:
        (flight / "geotags").symlink_to(tmp_path / "elsewhere")
        with pytest.raises(OutsideError, match="geotags is a link"):
            geotags.write(flight, geotags.PlacedBy(Mounting()))
    assert os.listdir(tmp_path / "elsewhere") == []


@pytest.mark.parametrize("table", ["frames", "strays"])
def test_check_names_it_and_goes_on(flight: Path, table: str) -> None:
    edit(flight, "../victim.txt", table)
    durable.write_file(flight / "frames" / "000001.cr2", b"raw X")
    problems = words_of(flight_check.check(flight).problems)
    assert any("names '../victim.txt', which does not stay inside" in text for text in problems)
    assert any("000001.cr2 was changed" in text for text in problems)


def test_check_confines_the_inputs_too(flight: Path) -> None:
    with Ledger(flight / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
        ledger.set_fact("sha256:../victim.txt", [durable.hash_file(flight.parent / "victim.txt")])
    assert any("names '../victim.txt'" in text for text in words_of(flight_check.check(flight).problems))


@pytest.mark.parametrize("part", ["flight.sqlite", "shots.jsonl", "telemetry.tlog", "frames", "flight.toml"])
def test_a_flight_whose_own_parts_are_links_is_refused(flight: Path, tmp_path: Path, part: str) -> None:
    shutil.move(flight / part, tmp_path / "elsewhere")
    (flight / part).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OutsideError, match=f"{part} is a link"):
        layout.open_folder(flight)
    with pytest.raises(OutsideError, match=f"{part} is a link"):
        recovery.recover_flight(FlightFolder(flight), RecordedClock(START_UTC_NS))


def test_recovery_adopts_no_link_and_removes_nothing_behind_one(tmp_path: Path) -> None:
    flight = recording.begin(tmp_path / "flights", RecordedClock(START_UTC_NS))
    request(flight, 0)
    frames, folder = flight.folder.frames, flight.folder
    flight.close()
    (tmp_path / "victim.cr2").write_bytes(SECRET)
    (tmp_path / ".victim.part").write_bytes(SECRET)
    (frames / "000000.cr2").symlink_to(tmp_path / "victim.cr2")
    report = recovery.recover_flight(folder, RecordedClock(START_UTC_NS))
    assert [one.facts["file"] for one in report if one.code is Code.FILE_NOT_FOLLOWED] == ["frames/000000.cr2"]
    (frames / "000000.cr2").unlink()
    frames.rmdir()
    frames.symlink_to(tmp_path)
    with pytest.raises(OutsideError, match="frames is a link"):
        recovery.recover_flight(folder, RecordedClock(START_UTC_NS))
    assert (tmp_path / ".victim.part").read_bytes() == SECRET


def test_a_run_s_recipe_names_files_of_the_flight_only(flight: Path) -> None:
    recipe = {"camera": "inputs/spring/cameras/a.toml", "mask": "mask-1", "white": "/etc/hostname"}
    with Ledger(flight / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
        ledger.set_fact("run:spring", {"recipe": recipe, "names": {"camera": "a", "mask": "b", "law": ""}})
    with pytest.raises(OutsideError, match="names '/etc/hostname'"):
        runs.of_flight(flight, "spring")


def test_a_run_s_camera_may_not_lead_out_either(flight: Path) -> None:
    recipe = {"camera": "../victim.toml", "mask": "mask-1"}
    with Ledger(flight / "flight.sqlite", RecordedClock(START_UTC_NS)) as ledger:
        ledger.set_fact("run:spring", {"recipe": recipe, "names": {"camera": "a", "mask": "b", "law": ""}})
    with pytest.raises(OutsideError, match=r"names '../victim.toml'"):
        runs.of_flight(flight, "spring")


def test_the_index_names_flights_of_its_own_folder_only(flight: Path, tmp_path: Path) -> None:
    shutil.copytree(flight, tmp_path / "foreign")
    with closing(sqlite3.connect(flight.parent / "index.sqlite")) as index, index:
        index.execute("PRAGMA foreign_keys=OFF")
        index.execute("UPDATE images SET flight = '../foreign'")
    with ImageIndex(flight.parent) as images:
        with pytest.raises(OutsideError, match=r"index.sqlite names '../foreign'"):
            images.flight("../foreign")
        assert camera_status.captured_image(0, images) is None


def test_a_manifest_names_outputs_of_its_own_folder_only(tmp_path: Path) -> None:
    (tmp_path / "victim.txt").write_bytes(SECRET)
    with Manifest(tmp_path / "batch") as manifest:
        outputs = (BatchOutput("../victim.txt", len(SECRET), "ab", "npz"),)
        manifest.add(Done("key", "flight", "frame", outputs, None, 0.0, 0.0, 0.0))
        with pytest.raises(OutsideError, match=r"manifest.jsonl names '../victim.txt'"):
            manifest.holds("key")


def test_a_pattern_for_a_folder_of_frames_stays_in_it(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    (tmp_path / "other.cr2").write_bytes(b"raw")
    with pytest.raises(OutsideError, match=r"the pattern '../\*.cr2' names '../other.cr2'"):
        replay.of_folder(tmp_path / "frames", "../*.cr2", None, 0, 1.0)


def light_field() -> LightField:
    return LightField(
        slices=np.ones((1, 2, 2), dtype=np.complex64),
        carriers=np.zeros((1, 4)),
        views=np.ones((1, 1, 2, 2), dtype=np.float32),
        view_offsets=np.zeros((1, 1, 2)),
        grid=np.zeros((2, 3)),
        attributes={},
    )


def test_a_light_field_s_parts_are_no_links(tmp_path: Path) -> None:
    pytest.importorskip("zarr", reason="Zarr is an extra")
    light_files.save(tmp_path / "a.zarr", light_field())
    shutil.move(tmp_path / "a.zarr" / "views", tmp_path / "views")
    (tmp_path / "a.zarr" / "views").symlink_to(tmp_path / "views")
    with pytest.raises(DappledError, match=r"a.zarr holds 'views', but .*views is a link"):
        light_files.load(tmp_path / "a.zarr")


@pytest.mark.parametrize("how", ["external link", "soft link", "external storage", "virtual"])
def test_a_light_field_s_arrays_stand_in_its_own_file(tmp_path: Path, how: str) -> None:
    h5py = pytest.importorskip("h5py", reason="HDF5 is an extra")
    light_files.save(tmp_path / "a.h5", light_field())
    light_files.save(tmp_path / "other.h5", light_field())
    (tmp_path / "other.raw").write_bytes(bytes(16))
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        if how == "soft link":
            file.move("views", "elsewhere")
            file["views"] = h5py.SoftLink("/elsewhere")
        else:
            del file["views"]
        if how == "external link":
            file["views"] = h5py.ExternalLink("other.h5", "views")
        elif how == "external storage":
            raw = [(str(tmp_path / "other.raw"), 0, 16)]
            file.create_dataset("views", (1, 1, 2, 2), np.float32, external=raw)
        elif how == "virtual":
            parts = h5py.VirtualLayout((1, 1, 2, 2), np.float32)
            parts[...] = h5py.VirtualSource(str(tmp_path / "other.h5"), "views", (1, 1, 2, 2))
            file.create_virtual_dataset("views", parts)
    with pytest.raises(DappledError, match=r"a.h5: views stands in another file, which is not followed"):
        light_files.load(tmp_path / "a.h5")
