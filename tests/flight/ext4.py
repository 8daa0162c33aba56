"""A real ext4 in a file, mounted by root; what stands in the file is what a power cut would leave."""

from __future__ import annotations

import filecmp
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest

MB = 1_000_000


@dataclass
class Image:
    """An ext4 in a file, mounted; `cut` is what its block device holds at this moment."""

    file: Path
    mounted: Path

    def cut(self, name: str) -> Path:
        copy = self.file.with_name(name)
        run("cp", "--sparse=always", str(self.file), str(copy))
        while not filecmp.cmp(self.file, copy, shallow=False):  # something was written meanwhile
            run("cp", "--sparse=always", str(self.file), str(copy))
        return copy

    def break_down(self) -> None:
        """The kernel finds an error on it and makes it read-only."""
        mounts = [line.split() for line in Path("/proc/mounts").read_text().splitlines()]
        device = next(words[0] for words in mounts if words[1] == str(self.mounted))
        Path("/sys/fs/ext4", Path(device).name, "trigger_fs_error").write_text("1")


def run(*words: str, good: tuple[int, ...] = (0,)) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode not in good:
        raise OSError(f"{' '.join(words)}: {done.stderr.strip()}")


def mount(image: Path, place: Path) -> None:
    place.mkdir(exist_ok=True)
    run("mount", "-o", "loop,errors=remount-ro", str(image), str(place))


def unmount(place: Path) -> None:
    run("umount", str(place))


@contextmanager
def an_image(folder: Path, size_mb: int = 32) -> Iterator[Image]:
    """A new one, mounted in the folder; skips where this user may not."""
    if os.geteuid() != 0 or shutil.which("mkfs.ext4") is None:
        pytest.skip("only root may mount an ext4 image")
    made = Image(folder / "image", folder / "mounted")
    with made.file.open("wb") as file:
        file.truncate(size_mb * MB)
    run("mkfs.ext4", "-q", "-F", str(made.file))
    try:
        mount(made.file, made.mounted)
    except OSError as error:
        pytest.skip(f"no image can be mounted here: {error}")
    try:
        yield made
    finally:
        unmount(made.mounted)
