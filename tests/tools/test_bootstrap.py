"""Setting up on a machine whose Python has no pip: uv comes from its releases, checked, and stays in .tools/."""

from __future__ import annotations

import hashlib
import http.server
import importlib.util
import io
import platform
import re
import sys
import tarfile
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest


@pytest.fixture
def bootstrap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    path = Path(__file__).parents[2] / "tools" / "bootstrap.py"
    spec = importlib.util.spec_from_file_location("bootstrap", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "TOOLS", tmp_path / "tools")
    (tmp_path / "tools").mkdir()
    return module


@pytest.fixture
def releases(tmp_path: Path) -> Iterator[tuple[str, Path]]:
    """A server with one release of a program called uv, and its folder."""
    folder = tmp_path / "releases"
    folder.mkdir()
    name = f"uv-{platform.machine()}-unknown-linux-gnu"
    program = b"#!/bin/sh\necho uv\n"
    with tarfile.open(folder / f"{name}.tar.gz", "w:gz") as tar:
        member = tarfile.TarInfo(f"{name}/uv")
        member.size = len(program)
        tar.addfile(member, io.BytesIO(program))
    digest = hashlib.sha256((folder / f"{name}.tar.gz").read_bytes()).hexdigest()
    (folder / f"{name}.tar.gz.sha256").write_text(f"{digest}  {name}.tar.gz\n")

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """Nothing: tests are quiet."""

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}", folder
        server.shutdown()


def test_a_released_uv_is_put_into_tools(bootstrap: ModuleType, releases: tuple[str, Path]) -> None:
    bootstrap.fetch_release(releases[0])
    uv = bootstrap.TOOLS / "uv"
    assert uv.read_bytes().startswith(b"#!/bin/sh")
    assert uv.stat().st_mode & 0o111


def test_a_changed_release_is_refused(bootstrap: ModuleType, releases: tuple[str, Path]) -> None:
    (archive,) = releases[1].glob("*.tar.gz")
    archive.write_bytes(archive.read_bytes() + b"x")
    with pytest.raises(SystemExit, match="does not match its SHA-256"):
        bootstrap.fetch_release(releases[0])
    assert not (bootstrap.TOOLS / "uv").exists()


def test_no_network_is_one_sentence(bootstrap: ModuleType) -> None:
    with pytest.raises(SystemExit, match="connect to the network, or install uv"):
        bootstrap.fetch_release("http://127.0.0.1:9")


def test_what_the_environment_is_made_from_is_the_lock(bootstrap: ModuleType) -> None:
    whole = bootstrap.ingredients("requirements.lock", "pyproject.toml")
    assert len(whole) == 64
    assert whole == bootstrap.ingredients("requirements.lock", "pyproject.toml")
    assert whole != bootstrap.ingredients("requirements-peers.lock")


def test_what_nothing_reads_is_removed_and_the_rest_compiled(bootstrap: ModuleType, tmp_path: Path) -> None:
    packages = tmp_path / "site-packages"
    kept = [
        "a/b.py",
        "tests.py",
        *(f"pymavlink/dialects/v20/{name}.py" for name in ("__init__", "all", "ardupilotmega")),
    ]
    gone = ["a/b/tests/c.py", "tests/c.py", "pymavlink/dialects/v10/common.py"]
    for name in (*kept, *gone):
        (packages / name).parent.mkdir(parents=True, exist_ok=True)
        (packages / name).write_text("")
    bootstrap.tidy(packages, sys.executable)
    assert sorted(str(one.relative_to(packages)) for one in packages.rglob("*.py")) == sorted(kept)
    assert len(list(packages.rglob("*.pyc"))) == len(kept)


def test_the_smaller_environment_is_part_of_the_whole_one(bootstrap: ModuleType) -> None:
    def pinned(lock: str) -> set[str]:
        return set(re.findall(r"^[\w.-]+==\S+", (bootstrap.ROOT / lock).read_text(encoding="utf-8"), re.MULTILINE))

    assert pinned(bootstrap.LOCK) < pinned(bootstrap.EVERYTHING)


def test_uv_is_one_version_by_its_hashes(bootstrap: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def pip(command: list[str], **_: object) -> SimpleNamespace:
        asked.append(command)
        return SimpleNamespace(returncode=1)

    monkeypatch.setattr(bootstrap.subprocess, "run", pip)
    monkeypatch.setattr(bootstrap, "debian_pip", lambda _: None)
    monkeypatch.setenv("DAPPLED_UV_RELEASES", "http://127.0.0.1:9")
    with pytest.raises(SystemExit):
        bootstrap.fetch_uv()
    assert asked[0][-3:] == ["--require-hashes", "-r", str(bootstrap.UV_LOCK)]
    assert re.match(r"uv==[\d.]+ \\\n    --hash=sha256:", bootstrap.UV_LOCK.read_text(encoding="utf-8"))


@pytest.mark.parametrize("file", ["tools/deb.py", "tools/install.py", "Containerfile"])
def test_what_builds_a_package_is_pinned(bootstrap: ModuleType, file: str) -> None:
    lock = (bootstrap.ROOT / "requirements-build.lock").read_text(encoding="utf-8")
    assert re.search(r"^hatchling==\S+ \\\n    --hash=sha256:", lock, re.MULTILINE)
    text = (bootstrap.ROOT / file).read_text(encoding="utf-8")
    builds = re.findall(r'"build", "-q".*|pip wheel .*', text)
    assert builds
    assert all("BUILD_LOCK" in one or "--no-build-isolation" in one for one in builds)
