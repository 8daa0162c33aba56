#!/usr/bin/env python3
"""Install dappled as a service under a prefix, or remove it: `make install PREFIX=…`, `make uninstall PREFIX=…`.

An environment of its own in PREFIX/lib/dappled, from the onboard lock with its hashes; the command in PREFIX/bin; the
unit, the udev rule, the service's user and its folders under PREFIX/lib; the configuration in SYSCONFDIR (default: /etc
for /usr and /usr/local, else PREFIX/etc), where an existing one is left as it is. DESTDIR stages all of it elsewhere.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from bootstrap import ROOT, fetch_uv, find_uv

SYSTEMD = ROOT / "systemd"
MANIFEST = "lib/dappled/installed.json"
BUILD_LOCK = ("--build-constraints", str(ROOT / "requirements-build.lock"), "--require-hashes")
COMMAND = '#!/bin/sh\nPYTHONPATH={home} exec {python} -P -m dappled "$@"\n'
"""`-P`, and no PYTHONPATH but its own: a folder that somebody else filled must not lend it modules."""
FLOWN = (
    "import compileall, dappled.cli.run, dappled.daemon.pipeline.decode_worker, dappled.drivers.gphoto2.process, "
    "libusb_package, usb.backend.libusb1, scipy.optimize, scipy.spatial; "
    "compileall.compile_dir(dappled.__path__[0], quiet=1)"
)
"""Makes bytecode of dappled and of what a flight loads, not of every dialect of MAVLink: the service itself may not
write there, and what has none is compiled at each start."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("do", choices=("install", "uninstall"))
    parser.add_argument("--prefix", type=Path, default=Path("/usr/local"))
    parser.add_argument("--destdir", type=Path, default=None, help="stage under this folder")
    parser.add_argument("--sysconfdir", type=Path, default=None)
    parser.add_argument("--python", default=sys.executable)
    given = parser.parse_args()
    prefix = given.prefix.absolute()
    in_system = prefix in (Path("/usr"), Path("/usr/local"))
    sysconfdir = (given.sysconfdir or (Path("/etc") if in_system else prefix / "etc")).absolute()
    place = Place(prefix, sysconfdir, given.destdir.absolute() if given.destdir else None)
    try:
        return install(place, given.python, in_system) if given.do == "install" else uninstall(place)
    except PermissionError as error:
        print(f"{error.filename}: not allowed; use sudo, or a PREFIX of your own", file=sys.stderr)
        return 1


class Place:
    """Where things go, as they will be named (`prefix`) and as they are written (`at`)."""

    def __init__(self, prefix: Path, sysconfdir: Path, destdir: Path | None) -> None:
        self.prefix, self.sysconfdir, self.destdir = prefix, sysconfdir, destdir

    def at(self, path: Path) -> Path:
        return path if self.destdir is None else self.destdir / path.relative_to("/")


def install(place: Place, python: str, in_system: bool) -> int:
    uv = find_uv() or fetch_uv()
    real = os.path.realpath(python)
    if in_system and real.startswith(("/home/", "/root/")):
        print(
            f"{real} lies in a home folder, which the service may not see: use PYTHON=/usr/bin/python3", file=sys.stderr
        )
        return 1
    home = place.prefix / "lib/dappled"
    environment(uv, python, place.at(home))
    written: list[Path] = []

    def put(path: Path, text: str) -> None:
        target = place.at(path)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")
        target.chmod(0o644)
        written.append(path)

    command = place.prefix / "bin/dappled"
    put(command, COMMAND.format(home="", python=home / "bin/python"))
    place.at(command).chmod(0o755)
    for path, text in service_files(place.prefix, place.sysconfdir, command).items():
        put(path, text)
    example = (SYSTEMD / "dappled.toml").read_text(encoding="utf-8")
    settings = place.sysconfdir / "dappled/dappled.toml"
    if place.at(settings).exists():
        print(f"kept      {settings}")
    else:
        put(settings, example)
    manifest = {"files": [str(path) for path in written if path != settings], "settings": str(settings)}
    place.at(place.prefix / MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    print(f"installed {command}\nsettings  {settings}\nunit      {place.prefix}/lib/systemd/system/dappled.service")
    print(next_steps(place, in_system))
    return 0


def service_files(prefix: Path, sysconfdir: Path, command: Path) -> dict[Path, str]:
    """The unit, the service's user and folders, and the udev rules: where each stands, and its text."""
    lib, etc = prefix / "lib", str(sysconfdir / "dappled")
    unit = (SYSTEMD / "dappled.service").read_text(encoding="utf-8").replace("/usr/local/bin/dappled", str(command))
    found = {
        lib / "systemd/system/dappled.service": unit,
        lib / "systemd/system/dappled@.service": template(unit),
        lib / "sysusers.d/dappled.conf": (SYSTEMD / "dappled.sysusers").read_text(encoding="utf-8"),
        lib / "tmpfiles.d/dappled.conf": (SYSTEMD / "dappled.tmpfiles").read_text(encoding="utf-8"),
    }
    for rule in sorted(SYSTEMD.glob("*.rules")):
        found[lib / "udev/rules.d" / rule.name] = rule.read_text(encoding="utf-8")
    return {path: text.replace("/etc/dappled", etc) for path, text in found.items()}


INSTANCE = (
    ("# dappled as a service.", "# One of several dappled services: `dappled@left` reads /etc/dappled/left.toml."),
    ("acquisition daemon for masked light-field cameras", "acquisition daemon, camera %i"),
    ("/etc/dappled/dappled.toml", "/etc/dappled/%i.toml"),
    ("StateDirectory=dappled", "StateDirectory=dappled-%i"),
    ("RuntimeDirectory=dappled", "RuntimeDirectory=dappled-%i"),
    ("HOME=/var/lib/dappled", "HOME=/var/lib/dappled-%i"),
    ("MemoryMax=85%", "MemoryMax=45%"),
)
"""What the unit of one camera of several has in place of the unit of the only one: folders of its own, less memory."""


def template(unit: str) -> str:
    """The template unit `dappled@.service` from the unit of a single camera. Raises ValueError where a line of the
    unit is not there any more."""
    for old, new in INSTANCE:
        if unit.count(old) != 1:
            raise ValueError(f"dappled.service has {old!r} {unit.count(old)} times, not once")
        unit = unit.replace(old, new)
    return unit


def environment(uv: str, python: str, home: Path) -> None:
    """A virtual environment with what the onboard lock names, and dappled itself; no tests, no caches."""
    shutil.rmtree(home, ignore_errors=True)
    home.parent.mkdir(parents=True, exist_ok=True)
    call(uv, "venv", "-q", "--python", python, str(home))
    into = ["--python", str(home / "bin/python"), "--link-mode", "copy"]
    lock = ["--require-hashes", "--no-deps", "-r", str(ROOT / "requirements-onboard.lock")]
    call(uv, "pip", "install", "-q", *into, *lock)
    with tempfile.TemporaryDirectory() as folder:
        call(uv, "build", "-q", "--wheel", *BUILD_LOCK, "--out-dir", folder, str(ROOT))
        wheel = next(Path(folder).glob("*.whl"))
        call(uv, "pip", "install", "-q", "--no-deps", *into, str(wheel))
    for tests in [path for path in home.glob("lib/python3*/site-packages/*/**/tests") if path.is_dir()]:
        shutil.rmtree(tests)
    call(str(home / "bin/python"), "-P", "-c", FLOWN)


def call(*words: str) -> None:
    """Run a command that must succeed; its errors stand on stderr."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL, env=environment)


def next_steps(place: Place, in_system: bool) -> str:
    if place.destdir is not None:
        return "staged; package it"
    lib = place.prefix / "lib"
    link = "" if in_system else f"  systemctl link {lib}/systemd/system/dappled.service\n"
    names = ["", ""] if in_system else [f" {lib}/{folder}/dappled.conf" for folder in ("sysusers.d", "tmpfiles.d")]
    return (
        f"next, as root:\n  systemd-sysusers{names[0]}\n  systemd-tmpfiles --create{names[1]}\n"
        f"  udevadm control --reload\n{link}  systemctl daemon-reload\n  systemctl enable --now dappled"
    )


def uninstall(place: Place) -> int:
    """Remove what install wrote; flights and settings stay."""
    file = place.at(place.prefix / MANIFEST)
    if not file.exists():
        print(f"nothing of dappled is installed under {place.prefix}", file=sys.stderr)
        return 1
    manifest = json.loads(file.read_text(encoding="utf-8"))
    for name in manifest["files"]:
        path = place.at(Path(name))
        path.unlink(missing_ok=True)
        prune(path.parent, place.at(place.prefix))
    shutil.rmtree(place.at(place.prefix / "lib/dappled"))
    prune(place.at(place.prefix / "lib"), place.at(place.prefix))
    print(f"removed; the settings {manifest['settings']} and all flights stay")
    return 0


def prune(folder: Path, until: Path) -> None:
    """Remove a folder and those above it, as long as they are empty, up to the prefix."""
    while folder != until and until in folder.parents and folder.is_dir() and not os.listdir(folder):
        folder.rmdir()
        folder = folder.parent


if __name__ == "__main__":
    sys.exit(main())
