#!/usr/bin/env python3
"""Set up .venv from requirements.lock: with the uv on PATH, or one fetched into .tools/. Touches nothing else.

    python tools/bootstrap.py              what the demo and the default tests need, in .venv
    python tools/bootstrap.py everything   there too: all extras, and what slow tests and notebooks need
    python tools/bootstrap.py peers        MAVSDK, MAVProxy and pycolmap, for some tests, in .venv-peers
    python tools/bootstrap.py docs         the programs that build the documents' site, in .venv-docs

Runs on a bare Python >= 3.11 (no pip, no venv module needed). Says nothing when all is in place.
"""

from __future__ import annotations

import hashlib
import importlib.util
import io
import os
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TOOLS = ROOT / ".tools"
VENV = ROOT / ".venv"
APART = ("peers", "docs")
LOCK, EVERYTHING = "requirements.lock", "requirements-everything.lock"
STAMP = "dappled-set-up"
# What packages bring and nothing here reads, a tenth of all: their own tests, and MAVLink's other dialects.
UNREAD = re.compile(r"(^|/)tests$|^pymavlink/dialects/v\d+/(?!all\.|ardupilotmega\.|__)[^/]+$")
# Large, and little of them is used: this gets its bytecode when it is first imported.
UNCOMPILED = r"/site-packages/(scipy|fontTools|rasterio|matplotlib)/"
# uv's own releases, for machines whose Python has neither pip nor ensurepip. DAPPLED_UV_RELEASES names a mirror.
UV_LOCK = ROOT / "requirements-uv.lock"  # one version, with the hashes of its wheels
RELEASES = "https://github.com/astral-sh/uv/releases/download"


def find_uv() -> str | None:
    """uv on PATH, or the one fetched earlier."""
    for place in (shutil.which("uv"), TOOLS / "bin" / "uv", TOOLS / "uv"):
        if place and Path(place).is_file():
            return str(place)
    return None


def fetch_uv() -> str:
    """A uv in .tools/: by Python's pip, else by Debian's, else from uv's releases."""
    print("fetching uv into .tools/ …", file=sys.stderr)
    TOOLS.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        wheel = None if importlib.util.find_spec("pip") else debian_pip(Path(folder))
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "install", "--target", str(TOOLS)]
        pip += ["--root-user-action=ignore", "--upgrade", "--require-hashes", "-r", str(UV_LOCK)]
        environment = {**os.environ, "PYTHONPATH": str(wheel)} if wheel else None
        if subprocess.run(pip, env=environment, check=False).returncode == 0 and (found := find_uv()):
            return found
    version = UV_LOCK.read_text(encoding="utf-8").partition("==")[2].split()[0]
    fetch_release(os.environ.get("DAPPLED_UV_RELEASES", f"{RELEASES}/{version}"))
    found = find_uv()
    if not found:
        raise SystemExit("uv could not be fetched: install it (https://docs.astral.sh/uv) and run make again")
    return found


def debian_pip(folder: Path) -> Path | None:
    """Debian's wheel of pip, unpacked in `folder` and installed nowhere; None where it can't be had."""
    apt, dpkg = shutil.which("apt-get"), shutil.which("dpkg-deb")
    if apt is None or dpkg is None:
        return None
    if os.geteuid() == 0:
        subprocess.run([apt, "-qq", "update"], check=False)
    download = [apt, "-qq", "download", "python3-pip-whl"]
    if subprocess.run(download, cwd=folder, stderr=subprocess.DEVNULL, check=False).returncode:
        return None
    for package in folder.glob("*.deb"):
        subprocess.run([dpkg, "--extract", package.name, "."], cwd=folder, check=False)
    return next(iter(folder.rglob("pip-*.whl")), None)


def fetch_release(releases: str) -> None:
    """Put uv's released binary for this machine into .tools/, its SHA-256 checked."""
    archive = f"uv-{platform.machine()}-unknown-linux-gnu.tar.gz"
    try:
        with urllib.request.urlopen(f"{releases}/{archive}", timeout=120) as answer:  # noqa: S310  # https, or a mirror the user named
            data = answer.read()
        with urllib.request.urlopen(f"{releases}/{archive}.sha256", timeout=60) as answer:  # noqa: S310  # as above
            wanted = answer.read().decode().split()[0]
    except OSError as error:
        advice = "connect to the network, or install uv, and run make again"
        raise SystemExit(f"uv could not be fetched from {releases} ({error}): {advice}") from error
    if hashlib.sha256(data).hexdigest() != wanted:
        raise SystemExit(f"uv from {releases} does not match its SHA-256: nothing was installed")
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        member = next(m for m in tar.getmembers() if m.isfile() and Path(m.name).name == "uv")
        source = tar.extractfile(member)
        if source is None:
            raise SystemExit(f"{archive} holds no uv")
        target = TOOLS / "uv"
        target.write_bytes(source.read())
        target.chmod(0o755)


def ingredients(*files: str) -> str:
    """A hash of what an environment is made from: these files, this Python, this folder."""
    content = b"".join((ROOT / file).read_bytes() for file in files)
    return hashlib.sha256(content + sys.version.encode() + str(ROOT).encode()).hexdigest()


def same_python(python: str) -> bool:
    """Whether the environment is there and made from the interpreter that runs this."""
    if not Path(python).exists():
        return False
    said = subprocess.run([python, "-c", "import sys; print(sys.version)"], capture_output=True, text=True, check=False)
    return said.stdout.strip() == sys.version.strip()


def make(venv: Path, lock: str, *, project: bool) -> None:
    """Make an environment from a lock, with the project in it or without. Does nothing where it is made already."""
    stamp = venv / STAMP
    wanted = ingredients(lock, *(["pyproject.toml"] if project else []))
    enough = {wanted, ingredients(EVERYTHING, "pyproject.toml")}
    if stamp.is_file() and stamp.read_text() in enough:
        return
    uv = find_uv() or fetch_uv()
    python = str(venv / "bin" / "python")

    def run(*arguments: str) -> None:
        if subprocess.run([uv, *arguments], cwd=ROOT, check=False).returncode:
            raise SystemExit(f"set-up stopped at: uv {' '.join(arguments)}")

    if not same_python(python):
        run("venv", "--quiet", "--clear", "--python", sys.executable, str(venv))
    run("pip", "sync", "--quiet", "--require-hashes", "--python", python, lock)
    if project:
        run("pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--python", python, "--editable", ".")
    if project:
        for packages in venv.glob("lib/python*/site-packages"):
            tidy(packages, python)
    stamp.write_text(wanted)


def tidy(packages: Path, python: str) -> None:
    """Remove what nothing reads, and compile the rest once: without bytecode each process of the tests would compile
    MAVLink's dialect anew, in 100 MB."""
    for path in sorted(packages.rglob("*")):
        if UNREAD.search(path.relative_to(packages).as_posix()):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    compiling = [python, "-m", "compileall", "-qq", "-j", "0", "-x", UNCOMPILED, str(packages)]
    subprocess.run(compiling, check=False)  # some packages bring files of other Pythons


def main() -> None:
    match sys.argv[1:]:
        case []:
            make(VENV, LOCK, project=True)
        case ["everything"]:
            make(VENV, EVERYTHING, project=True)
        case [name] if name in APART:
            make(ROOT / f".venv-{name}", f"requirements-{name}.lock", project=False)
        case other:
            raise SystemExit(
                f"there is no environment {' '.join(other)}: choose everything, {' or '.join(APART)}, or none"
            )


if __name__ == "__main__":
    main()
