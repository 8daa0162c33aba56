"""What this machine has left for one more photograph: file descriptors, and memory for the file on its way."""

from __future__ import annotations

import os
import resource
from dataclasses import dataclass
from pathlib import Path

from dappled.findings import Code, Finding, Subject, finding

FEWEST_DESCRIPTORS = 16  # a frame on its way, its companion, temporary files and folders
LEAST_MEMORY_BYTES = 48_000_000  # a raw file in the camera's process, and in a memfd where the disk refuses it


@dataclass(frozen=True, slots=True)
class ResourcesLeft:
    """Descriptors that this process may still open, and memory in bytes. None: unknown."""

    descriptors: int | None
    memory_bytes: int | None


def look(proc: Path = Path("/proc")) -> ResourcesLeft:
    """What is left now. Reads /proc, so not for the path of a command."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        used = len(os.listdir(proc / "self" / "fd"))
    except OSError:
        used = None
    unknown = used is None or soft == resource.RLIM_INFINITY
    return ResourcesLeft(None if unknown or used is None else max(0, soft - used), _memory_bytes(proc))


def shortage(left: ResourcesLeft) -> Finding | None:
    """Why no photograph could be kept; None where one can, as far as is known."""
    machine = Subject("machine")
    if left.descriptors is not None and left.descriptors < FEWEST_DESCRIPTORS:
        return finding(Code.MACHINE_FEW_DESCRIPTORS, machine, left=left.descriptors)
    if left.memory_bytes is not None and left.memory_bytes < LEAST_MEMORY_BYTES:
        return finding(Code.MACHINE_LITTLE_MEMORY, machine, left_mb=left.memory_bytes // 10**6)
    return None


def _memory_bytes(proc: Path) -> int | None:
    """MemAvailable, of which memory for a file is taken."""
    try:
        for line in (proc / "meminfo").read_text(encoding="ascii").splitlines():
            name, _, value = line.partition(":")
            if name == "MemAvailable":
                return int(value.split()[0]) * 1024
    except (OSError, ValueError, IndexError):
        pass
    return None
