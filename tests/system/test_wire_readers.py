"""The readers of docs/wire.md, in other languages, on a live simulated stream."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.needs import without
from tests.system.conftest import dappled, until_it_listens

ROOT = Path(__file__).parents[2]
FRAMES = 3
READERS = ROOT / "examples" / "readers"


def test_the_document_holds_the_readers() -> None:
    """Python's word for word, so that it can be copied from the page; the others by name, for the site to show."""
    document = (ROOT / "docs" / "wire.md").read_text(encoding="utf-8")
    assert f"```python\n{(READERS / 'python/reader.py').read_text(encoding='utf-8')}```\n" in document
    named = re.findall(r"^```\w+\nexamples/readers/(\S+)\n```$", document, re.MULTILINE)
    assert named == ["cpp/reader.cpp", "rust/Cargo.toml", "rust/src/main.rs", "octave/reader.m"]
    assert [name for name in named if not (READERS / name).is_file()] == []


def python(_: Path) -> list[str]:
    return [sys.executable, str(READERS / "python/reader.py")]


def cpp(folder: Path) -> list[str]:
    compiler = shutil.which("g++")
    if compiler is None or not Path("/usr/include/zmq.h").exists():
        without("no g++ with libzmq: apt install g++ libzmq3-dev nlohmann-json3-dev")
    source = str(READERS / "cpp/reader.cpp")
    subprocess.run(
        [compiler, "-std=c++17", "-O2", "-Wall", "-Wextra", "-Werror", source, "-o", "reader", "-lzmq"],
        cwd=folder,
        check=True,
        timeout=100,
    )
    return [str(folder / "reader")]


def rust(folder: Path) -> list[str]:
    cargo = shutil.which("cargo")
    if cargo is None:
        without("no Rust: apt install cargo")
    shutil.copytree(READERS / "rust", folder, dirs_exist_ok=True)
    fetched = subprocess.run(
        [cargo, "fetch", "--locked"], cwd=folder, check=False, timeout=100, capture_output=True, text=True
    )
    if fetched.returncode and "failed to" in fetched.stderr and "download" in fetched.stderr:
        pytest.skip(f"the crates can't be fetched here: {fetched.stderr.strip().splitlines()[-1]}")
    assert fetched.returncode == 0, fetched.stderr
    # The crate builds libzmq from source, once a machine.
    target = ROOT / "build" / "reader-rust"
    subprocess.run(
        [cargo, "build", "--locked", "--offline", "-q", "--target-dir", str(target)],
        cwd=folder,
        check=True,
        timeout=400,
    )
    return [str(target / "debug" / "reader")]


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("made", [python, *(pytest.param(one, marks=pytest.mark.long) for one in (cpp, rust))])
def test_a_reader_reads_a_live_stream(made: Callable[[Path], list[str]], tmp_path: Path, sockets: Path) -> None:
    """Each line names the frame, the shape and the mean of the first slice, as `dappled watch` keeps them."""
    folder = tmp_path / "reader"
    folder.mkdir()
    command = made(folder)
    endpoint = f"ipc://{sockets}/reader-{getattr(made, '__name__', '')}"
    (tmp_path / "dappled.toml").write_text(f'[record]\ndirectory = "flights"\n[publish]\nslices = "{endpoint}"\n')
    watch = [sys.executable, "-m", "dappled", "watch", endpoint, "--save", "received", "--count", str(FRAMES),
             "--timeout", "120"]  # fmt: skip
    reader = subprocess.Popen([*command, endpoint], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    keeper = subprocess.Popen(watch, cwd=tmp_path, stdout=subprocess.DEVNULL)
    try:
        until_it_listens(reader)
        until_it_listens(keeper)
        flown = dappled("run", "--simulate", "--frames", str(FRAMES), "--config", "dappled.toml", cwd=tmp_path)
        said, complaints = reader.communicate(timeout=120)
        assert keeper.wait(120) == 0
    finally:
        reader.kill()
        keeper.kill()
    assert flown.returncode == 0, flown.stderr
    assert reader.returncode == 0, complaints
    read = re.findall(r"^frame (\d+) slices (\d+)x(\d+)x(\d+) mean (-?[\d.]+)$", said, re.MULTILINE)
    kept = {int(path.stem): np.load(path) for path in (tmp_path / "received").glob("*.npy")}
    assert [int(line[0]) for line in read] == sorted(kept)
    for line in read:
        slices = kept[int(line[0])]
        assert tuple(map(int, line[1:4])) == slices.shape
        assert float(line[4]) == pytest.approx(float(slices[0].real.mean(dtype=float)), abs=2e-6)
