"""One folder under two names, two folders on one disk, and file systems that keep nothing: all are refused."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from dappled.cli import main
from dappled.clock import RecordedClock
from dappled.findings import Code
from dappled.flight import FlightError, Recording, offload, places, read_back
from dappled.flight.checks.flight_check import check
from dappled.flight.trees import Tree
from tests.flight.conftest import START_UTC_NS
from tests.flight.ext4 import Image
from tests.flight.makers import deliver, request
from tests.flight.test_disk_faults import ext4

__all__ = ["ext4"]
MEMORY = Path("/dev/shm")
pytestmark = pytest.mark.disk


@pytest.fixture
def closed(flight: Recording) -> Path:
    for index in range(4):
        request(flight, index)
        deliver(flight, index, b"raw %d" % index * 1000)
    flight.close()
    return flight.folder.path


def go(flight: Path, there: Path, *, prune: bool = True, same_device: bool = False) -> offload.Offloaded:
    return offload.offload(flight, there, prune=prune, same_device=same_device, clock=RecordedClock(START_UTC_NS))


def whole(flight: Path) -> None:
    assert len(os.listdir(flight / "frames")) == 4
    assert check(flight).problems == ()


# --- one folder under two names

IN_NAMESPACE = """
import json, os, subprocess, sys
from pathlib import Path
from dappled.cli import main
from dappled.flight import offload
flight, disk = Path(sys.argv[1]), Path(sys.argv[2])
def mount(*words):
    subprocess.run(["mount", *map(str, words)], check=True)
{mounts}
code = main(["flight", "offload", str(disk), str(flight), "--prune", *sys.argv[3:]])
print(json.dumps({{"code": code, "left": len(os.listdir(flight / "frames"))}}))
"""
MOUNTS = {
    "the flights folder": "mount('--bind', flight.parent, disk)",
    "the flight": "(disk / flight.name).mkdir(); mount('--bind', flight, disk / flight.name)",
    "its frames": "(disk / flight.name / 'frames').mkdir(parents=True); "
    "mount('--bind', flight / 'frames', disk / flight.name / 'frames')",
    "a folder above": "mount('--bind', flight.parent.parent, disk); disk = disk / flight.parent.name",
}


def in_namespace(mounts: str, flight: Path, disk: Path, *words: str) -> tuple[dict[str, Any], str]:
    """Offload with --prune where only this process sees the mounts."""
    unshare = ["unshare", "--user", "--map-root-user", "--mount"]
    if os.geteuid() == 0:
        unshare = ["unshare", "--mount"]
    tried = None if shutil.which("unshare") is None else subprocess.run([*unshare, "true"], check=False)
    if tried is None or tried.returncode:
        pytest.skip("this user may not make a mount namespace: nothing can be mounted twice")
    disk.mkdir()
    done = subprocess.run(
        [*unshare, sys.executable, "-c", IN_NAMESPACE.format(mounts=mounts), str(flight), str(disk), *words],
        cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    said: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return said, done.stderr


@pytest.mark.parametrize(("mounted", "insist"), [*((name, True) for name in MOUNTS), ("its frames", False)])
def test_a_bind_mount_of_the_source_is_no_copy(closed: Path, tmp_path: Path, mounted: str, insist: bool) -> None:
    """Reproduced 1a: all frames were "there already", and 93 of 93 were gone."""
    words = ["--same-device"] if insist else []
    said, why = in_namespace(MOUNTS[mounted], closed, tmp_path / "disk", *words)
    assert said == {"code": 1, "left": 4}
    assert "nothing was copied" in why
    if insist:
        assert "is the same folder as" in why
    whole(closed)


def test_an_overlay_over_the_source_is_no_copy(closed: Path, tmp_path: Path) -> None:
    """What is written there appears nowhere in the source, and what stands there is the source."""
    mounts = """
for name in "memory", "memory/upper", "memory/work":
    (disk.parent / name).mkdir()
    if name == "memory":
        mount("-t", "tmpfs", "dappled", disk.parent / name)
upper = disk.parent / "memory"
mount("-t", "overlay", "dappled", "-o", f"lowerdir={flight.parent},upperdir={upper}/upper,workdir={upper}/work", disk)
"""
    said, why = in_namespace(mounts, closed, tmp_path / "disk")
    assert said == {"code": 1, "left": 4}
    assert "--prune can't be sure of" in why
    assert "its file system is overlay" in why
    whole(closed)


def test_a_reexport_is_found_by_what_is_written_there(
    closed: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Another device number, other inodes, the same folder: as over a network."""
    numbers = itertools.count(1)
    monkeypatch.setattr(places, "_identity", lambda fd: (next(numbers), 0))
    monkeypatch.setattr(os.path, "sameopenfile", lambda one, other: False)
    with pytest.raises(FlightError, match=r"what is written into .* appears in .*: they are one folder"):
        go(closed, closed.parent, same_device=True)
    whole(closed)
    assert not list(closed.parent.rglob("*.part"))


# --- two folders on one disk


def test_the_same_device_is_refused_unless_insisted_on(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["flight", "offload", str(tmp_path / "disk"), str(closed)]
    assert main(words) == 1
    assert "nothing was copied; give a folder on another disk, or insist with --same-device" in capsys.readouterr().err
    assert not (tmp_path / "disk").exists()
    monkeypatch.setattr(places, "disks", lambda fd: frozenset())
    assert main(words) == 1
    assert f"{tmp_path} is on the same device as {closed}" in capsys.readouterr().err
    assert main([*words, "--same-device"]) == 0
    whole(tmp_path / "disk" / closed.name)


@pytest.fixture
def memory(tmp_path: Path) -> Any:
    """A folder on another device."""
    if not MEMORY.is_dir() or MEMORY.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("there is no second device here")
    place = MEMORY / f"dappled-{os.getpid()}-{tmp_path.name}"
    place.mkdir()
    yield place
    shutil.rmtree(place)


def test_two_file_systems_on_one_disk_are_one_place(
    closed: Path, memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(places, "disks", lambda fd: frozenset({"sda"}))
    with pytest.raises(FlightError, match=r"is on the same disk \(sda\) as"):
        go(closed, memory, prune=False)
    assert os.listdir(memory) == []
    monkeypatch.undo()
    assert go(closed, memory, prune=False).copied == 9


def test_a_copy_in_memory_is_made_and_doubted_and_nothing_is_removed_for_it(closed: Path, memory: Path) -> None:
    done = go(closed, memory, prune=False)
    assert (done.file_system, [one.code for one in done.doubts]) == ("tmpfs", [Code.COPY_MAY_NOT_LAST])
    with pytest.raises(FlightError, match=r"--prune can't be sure of .*: its file system is tmpfs"):
        go(closed, memory)
    whole(closed)


def test_a_copy_in_doubt_is_no_success(closed: Path, memory: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["flight", "offload", str(memory), str(closed)]
    assert main(words) == 1
    assert "in doubt: copy" in capsys.readouterr().err
    assert main([*words, "--anyway"]) == 0


def test_a_partition_a_volume_and_an_image_are_on_their_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def device(path: str, number: str) -> Path:
        (tmp_path / path).mkdir(parents=True)
        (tmp_path / path / "dev").write_text(number)
        (tmp_path / "by-number").mkdir(exist_ok=True)
        (tmp_path / "by-number" / number).symlink_to(tmp_path / path)
        return tmp_path / path

    device("sda", "8:0")
    (device("sda/sda1", "8:1") / "partition").write_text("1")
    (device("dm-0", "252:0") / "slaves").mkdir()
    (tmp_path / "dm-0/slaves/sda1").symlink_to(tmp_path / "sda/sda1")
    (device("loop0", "7:0") / "loop").mkdir()
    (tmp_path / "loop0/loop/backing_file").write_text(f"{tmp_path}/image\n")
    (tmp_path / "image").write_bytes(b"")
    real = os.stat(tmp_path / "image").st_dev
    device("nvme0", f"{os.major(real)}:{os.minor(real)}")
    monkeypatch.setattr(places, "_DEVICES", tmp_path / "by-number")
    assert places._disks_of(os.makedev(8, 1)) == {"sda"}
    assert places._disks_of(os.makedev(252, 0)) == {"sda"}
    assert places._disks_of(os.makedev(7, 0)) == {"nvme0"}
    assert places._disks_of(os.makedev(99, 0)) == frozenset()


# --- what a file system keeps


def test_the_kind_of_file_system_is_that_of_the_descriptor(tmp_path: Path) -> None:
    with Tree(tmp_path) as tree:
        found = places.file_system(tree.folders[""])
    listed = [path.read_text() for path in places._MOUNTS if os.access(path, os.R_OK)]
    assert found in {line.split(" - ")[1].split(" ")[0] for text in listed for line in text.splitlines()}
    with Tree(Path("/proc")) as tree:
        assert places.file_system(tree.folders[""]) == "proc"
    assert places.file_system(10**6) == "unknown"


def test_in_a_chroot_the_mounts_of_the_whole_machine_are_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inside one, a process' own list leaves out the file system that it stands on."""
    with Tree(tmp_path) as tree:
        found = places.file_system(tree.folders[""])
        inside = tmp_path / "inside"
        inside.write_text("61 60 0:5 / /proc rw - proc proc rw\n")
        whole_machine = places._MOUNTS
        monkeypatch.setattr(places, "_MOUNTS", (inside, *whole_machine))
        assert places.file_system(tree.folders[""]) == found != "unknown"
        monkeypatch.setattr(places, "_MOUNTS", (inside,))
        assert places.file_system(tree.folders[""]) == "unknown"


@pytest.mark.parametrize("system", ["fuse", "fuse.sshfs", "fuseblk", "overlay", "unknown", "zfs"])
def test_nothing_is_removed_for_a_file_system_that_is_not_known(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, system: str
) -> None:
    monkeypatch.setattr(places, "file_system", lambda fd: system)
    with pytest.raises(FlightError, match=rf"its file system is {system}, .* nothing was copied"):
        go(closed, tmp_path / "disk", same_device=True)
    whole(closed)


def test_over_a_network_every_file_is_written_anew_before_anything_is_removed(
    closed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What stands on another machine may be the source itself; what this run wrote is not."""
    monkeypatch.setattr(places, "file_system", lambda fd: "nfs4")
    first = go(closed, tmp_path / "disk", prune=False, same_device=True)
    before = {path: path.stat().st_ino for path in (first.destination / "frames").iterdir()}
    done = go(closed, tmp_path / "disk", same_device=True)
    assert done.pruned == 4
    assert all(path.stat().st_ino != inode for path, inode in before.items())
    assert [(one.code, one.facts["system"]) for one in done.doubts] == [(Code.COPY_REMOTE, "nfs4")]


# --- past the page cache


def test_a_file_is_read_from_its_disk(ext4: Image) -> None:
    """On a real ext4: the page cache has one thing, the block device another."""
    path = ext4.mounted / "a"
    path.write_bytes(b"what was written" * 1000)
    with Tree(ext4.mounted) as tree:
        good, how = read_back.hash_on_disk("a", tree.folders[""])
        assert how == "O_DIRECT"
        device = next(
            line.split()[0] for line in Path("/proc/mounts").read_text().splitlines() if str(ext4.mounted) in line
        )
        data = Path(device).read_bytes()
        at = data.index(b"what was written" * 1000)
        path.read_bytes()  # into the cache
        with open(device, "r+b") as disk:
            disk.seek(at)
            disk.write(b"WHAT")
            disk.flush()
            os.fsync(disk.fileno())
        assert path.read_bytes().startswith(b"what")
        assert read_back.hash_on_disk("a", tree.folders[""])[0] != good


@pytest.mark.parametrize("size", [0, 1, 4096, 5000, 3 * (1 << 20) + 17])
def test_the_three_ways_of_reading_agree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int) -> None:
    data = os.urandom(size)
    (tmp_path / "a").write_bytes(data)
    with Tree(tmp_path) as tree:
        fd = tree.folders[""]
        first, _ = read_back.hash_on_disk("a", fd)
        monkeypatch.setattr(read_back, "_direct", lambda name, folder, size: None)
        second, how = read_back.hash_on_disk("a", fd)
        assert how in ("dropped pages", "page cache")
    assert first == second == hashlib.sha256(data).hexdigest()


def test_a_flight_is_pruned_for_a_copy_on_a_real_second_file_system(closed: Path, ext4: Image) -> None:
    """An image on the source's disk: another device, and yet the same disk."""
    with pytest.raises(FlightError, match="is on the same disk"):
        go(closed, ext4.mounted)
    done = go(closed, ext4.mounted, same_device=True)
    assert (done.pruned, done.file_system, done.read_back, done.doubts) == (4, "ext4", ("O_DIRECT",), ())
    assert check(done.destination).problems == ()
