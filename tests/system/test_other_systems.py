"""A laptop with macOS or Windows: light fields and frames are read there without what only Linux or POSIX has."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from dappled.mocks.scene.masked_camera import reference_camera
from dappled.products.exports import light_files
from tests.products.fields import light_field

WITHOUT = """
import os, select, shutil, signal, sys

LINUX = {"fcntl", "termios", "pty", "pwd", "grp", "resource", "syslog", "gpiod", "gphoto2"}

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in LINUX:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
for name in LINUX:
    sys.modules.pop(name, None)
for name in ("memfd_create", "fork", "geteuid", "getuid", "posix_fadvise", "sched_setaffinity", "register_at_fork",
             "O_DIRECT", "O_CLOEXEC", "O_NOFOLLOW", "O_DIRECTORY", "O_NONBLOCK", "O_PATH"):
    delattr(os, name)
shutil._use_fd_functions = False  # as Python itself decides where files have no such descriptors
for name in ("epoll", "poll"):
    delattr(select, name)
for name in ("SIGPIPE", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGKILL", "pthread_sigmask"):
    delattr(signal, name)
os.name != "nt" and delattr(os, "posix_fallocate")
"""


def run(code: str, *words: str) -> str:
    done = subprocess.run([sys.executable, "-c", WITHOUT + code, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("suffix", [".npz", *(pytest.param(one, marks=pytest.mark.slow) for one in (".zarr", ".h5"))])
def test_a_light_field_opens(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a{suffix}"
    light_files.save(path, light_field())
    code = """
import dappled
found = dappled.open(sys.argv[1])
print(found.views.shape, found.refocus(disparity=0.4).shape)
found.save(sys.argv[1] + ".copy.npz")
"""
    assert run(code, str(path)) == "(5, 5, 60, 80) (60, 80)\n"
    assert (tmp_path / f"a{suffix}.copy.npz").exists()


@pytest.mark.slow
def test_a_frame_is_decoded_from_python_and_at_a_prompt(tmp_path: Path) -> None:
    frame = tmp_path / "frame.dng"
    frame.write_bytes(reference_camera(1, scale=0.5).expose(1.0, 0).file)
    code = """
import dappled
from dappled.cli import main
frame, out = sys.argv[1:]
print(dappled.open(frame, mask="reference-5x5").light_field.slices.shape[0], flush=True)
sys.exit(main(["decode", frame, "--mask", "reference-5x5", "-o", out]))
"""
    said = run(code, str(frame), str(tmp_path / "frame.npz"))
    assert "24 of 24 carriers seen" in said
    assert said.startswith("13\n")
    assert (tmp_path / "frame.npz").exists()
