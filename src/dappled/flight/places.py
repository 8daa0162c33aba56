"""Say whether two folders are on different disks, and what a file system promises about fsync.

Paths prove nothing: a bind mount, a link or a re-export shows one folder under two names. Device and inode tell them
apart on one machine. Over a network they don't: there, a file with a random name that is made in the one folder must
not appear in the other.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
from collections.abc import Mapping
from pathlib import Path

from dappled import durable
from dappled.flight.errors import FlightError, disk_errors
from dappled.flight.trees import Tree

KEEPS_FSYNC = frozenset(
    ("ext2", "ext3", "ext4", "xfs", "btrfs", "f2fs", "bcachefs", "jfs", "nilfs2", "reiserfs", "ubifs", "jffs2", "vfat",
     "msdos", "exfat", "ntfs3", "hfsplus", "udf")
)  # fmt: skip
"""File systems on a disk of this machine, in the kernel: a file that was fsynced is on the disk."""
NETWORK = frozenset(("nfs", "nfs4", "cifs", "smb3", "ceph", "afs"))
"""File systems that hand an fsync to another machine, which is believed."""
_NONCE = re.compile(r"\.dappled-[0-9a-f]{32}\.part")
_MOUNTS = (Path("/proc/self/mountinfo"), Path("/proc/1/mountinfo"))
"""The second lists what lies outside a chroot, which the first leaves out; mount ids are the same in both."""
_DEVICES = Path("/sys/dev/block")


def file_system(fd: int) -> str:
    """The kind of file system behind a descriptor, as "ext4"; "unknown" where the kernel doesn't say."""
    return _mount(fd)[0]


def disks(fd: int) -> frozenset[str]:
    """The physical disks behind a descriptor, as "sda": below partitions, volumes and images. Empty where unknown."""
    source = Path(_mount(fd)[1])
    device = os.fstat(fd).st_dev
    with contextlib.suppress(OSError):
        if source.is_block_device():  # btrfs gives its files devices that no disk has
            device = source.stat().st_rdev
    return _disks_of(device)


def volatile(fd: int) -> str:
    """Why the disk behind a descriptor may forget what was fsynced to it; "" where nothing says so."""
    _, _, options = _mount(fd)
    if options & {"nobarrier", "barrier=0"}:
        return "it is mounted without write barriers"
    memory = sorted(name for name in disks(fd) if name.startswith(("zram", "ram")))
    return f"{memory[0]} is a disk in memory" if memory else ""


def refuse_same_place(source: Tree, there: Tree, *, same_device: bool) -> None:
    """Compare every open folder of the copy with every one of the source, by device, inode and disk.

    Raises FlightError where a folder is in both or the copy lies within the source, whatever is insisted on; and where
    both are on one device or disk, unless `same_device` insists on that.
    """
    own = {_identity(fd): name for name, fd in source.folders.items()}
    for name, fd in there.folders.items():
        held = own.get(_identity(fd))
        if held is not None:
            raise FlightError(
                f"{there.path / name} is the same folder as {source.path / held} under another name: nothing was "
                "copied; give a folder on another disk"
            )
    for fd in there.above():
        if _identity(fd) in own:
            raise FlightError(f"cannot offload {source.path} into itself: {there.path}; give a folder on another disk")
    if same_device:
        return
    devices = {os.fstat(fd).st_dev for fd in source.folders.values()}
    shared = {os.fstat(fd).st_dev for fd in there.folders.values()} & devices
    known = frozenset[str]().union(*(disks(fd) for fd in source.folders.values()))
    same_disks = known & frozenset[str]().union(*(disks(fd) for fd in there.folders.values()))
    if shared or same_disks:
        which = f"disk ({', '.join(sorted(same_disks))})" if same_disks else "device"
        raise FlightError(
            f"{there.path} is on the same {which} as {source.path}, both would be lost with it: nothing was copied; "
            "give a folder on another disk, or insist with --same-device"
        )


def refuse_reexport(source: Tree, there: Tree) -> None:
    """Make a file with a random name in each folder of the copy, and look for it in each folder of the source.

    Raises FlightError where it appears: the two are one folder, over a network or through another file system.
    """
    nonce = durable.temporary(Path(f"dappled-{secrets.token_hex(16)}")).name
    for name, fd in there.folders.items():
        made = there.path / name / nonce
        with disk_errors("make and remove", made):
            for old in filter(_NONCE.fullmatch, os.listdir(fd)):
                os.unlink(old, dir_fd=fd)  # of an attempt that was cut short
            os.close(os.open(nonce, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600, dir_fd=fd))
            try:
                seen = [held for held, own in source.folders.items() if _stands(nonce, own)]
            finally:
                os.unlink(nonce, dir_fd=fd)
        if seen:
            raise FlightError(
                f"what is written into {there.path / name} appears in {source.path / seen[0]}: they are one folder, "
                "and nothing was copied; give a folder on another disk"
            )


def _stands(name: str, folder: int) -> bool:
    with contextlib.suppress(FileNotFoundError):
        os.stat(name, dir_fd=folder, follow_symlinks=False)
        return True
    return False


def _identity(fd: int) -> tuple[int, int]:
    found = os.fstat(fd)
    return found.st_dev, found.st_ino


def _mount(fd: int) -> tuple[str, str, frozenset[str]]:
    """Kind, source and options of the mount behind a descriptor, from proc(5); ("unknown", "", none) where it is not
    listed."""
    with contextlib.suppress(OSError, ValueError, KeyError):
        notes = dict(line.split(":\t", 1) for line in Path(f"/proc/self/fdinfo/{fd}").read_text().splitlines())
        number = notes["mnt_id"].strip()
        for listed in _MOUNTS:
            mounts = _mounts(listed)
            if number in mounts:
                return mounts[number]
    return "unknown", "", frozenset()


def _mounts(listed: Path) -> Mapping[str, tuple[str, str, frozenset[str]]]:
    found: dict[str, tuple[str, str, frozenset[str]]] = {}
    for line in listed.read_text(errors="surrogateescape").splitlines():
        before, _, after = line.partition(" - ")
        kind, source, *options = after.split(" ")
        found[before.split(" ", 1)[0]] = (kind, source, frozenset(",".join(options).split(",")))
    return found


def _disks_of(device: int) -> frozenset[str]:
    """The disks of a block device: the one that a partition is cut from, those below a volume, that of an image."""
    place = _DEVICES / f"{os.major(device)}:{os.minor(device)}"
    with contextlib.suppress(OSError):
        here = place.resolve(strict=True)
        if (here / "partition").exists():
            here = here.parent
        below = [path / "dev" for path in (here / "slaves").iterdir()] if (here / "slaves").is_dir() else []
        if below:
            return frozenset[str]().union(*(_disks_of(_number(path.read_text())) for path in below))
        image = here / "loop" / "backing_file"
        if image.exists():
            with durable.descriptor(image.read_text().strip(), os.O_RDONLY) as backing:
                return disks(backing)
        return frozenset({here.name})
    return frozenset()


def _number(text: str) -> int:
    major, minor = text.split(":")
    return os.makedev(int(major), int(minor))
