#!/usr/bin/env python3
"""Build Debian packages of dappled: `make deb`. They need no compiler and no index of Python packages when installed.

The onboard lock, as wheels of the wanted machine, and dappled itself stand in /usr/lib/dappled, where nothing else
looks for modules. A package is for one Debian release, since wheels are for one Python. Any machine can build for both
architectures.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from pathlib import Path

from bootstrap import ROOT, fetch_uv, find_uv
from install import BUILD_LOCK, COMMAND, FLOWN, service_files

HOME = Path("/usr/lib/dappled")
PYTHONS = {"bookworm": "3.11", "trixie": "3.13"}
PLATFORMS = {"amd64": "x86_64-manylinux_2_36", "arm64": "aarch64-manylinux_2_36"}

CONTROL = """\
Package: dappled
Version: {version}+{suite}
Architecture: {arch}
Maintainer: the dappled authors <dappled@localhost>
Section: science
Priority: optional
Installed-Size: {size_kib}
Depends: python3 (>= {python}), python3 (<< {next}), libc6, libstdc++6,
 systemd | systemd-standalone-sysusers | systemd-sysusers
Recommends: udev
Description: acquisition daemon for masked light-field cameras
 Fires a camera behind a printed mask over USB, records and tags its raw files,
 decodes their light fields in flight and publishes slices over ZeroMQ. Speaks
 MAVLink with autopilots and ground stations.
"""
POSTINST = f"""\
#!/bin/sh
set -e
if [ "$1" = configure ]; then
  command -v systemd-sysusers >/dev/null && systemd-sysusers dappled.conf
  command -v systemd-tmpfiles >/dev/null && systemd-tmpfiles --create dappled.conf || true
  PYTHONPATH={HOME} python3 -P -c "{FLOWN}"
  if [ -d /run/systemd/system ]; then
    systemctl daemon-reload || true
    udevadm control --reload || true
    systemctl try-restart dappled 'dappled@*' || true
  fi
fi
"""
PRERM = f"""\
#!/bin/sh
set -e
if [ "$1" = remove ] && [ -d /run/systemd/system ]; then
  systemctl stop 'dappled@*' || true
  systemctl disable dappled@ || true
  systemctl disable --now dappled || true
fi
find {HOME} -name __pycache__ -type d -prune -exec rm -rf {{}} +
"""
POSTRM = """\
#!/bin/sh
set -e
if [ -d /run/systemd/system ]; then systemctl daemon-reload || true; fi
if [ "$1" = purge ] && [ -d /var/lib/dappled ]; then echo "the flights in /var/lib/dappled* stay"; fi
"""


def main() -> int:
    """Build the packages that are asked for; the exit code is 1 without dpkg-deb."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--arch", choices=sorted(PLATFORMS), action="append", help="default: both")
    parser.add_argument("--suite", choices=sorted(PYTHONS), default="bookworm")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "deb")
    given = parser.parse_args()
    if shutil.which("dpkg-deb") is None:
        print("dpkg-deb is missing: install the package dpkg", file=sys.stderr)
        return 1
    for arch in given.arch or sorted(PLATFORMS):
        made = build(arch, given.suite, given.out)
        print(f"{made}  {made.stat().st_size / 1e6:.0f} MB")
    return 0


def build(arch: str, suite: str, out: Path) -> Path:
    """Stage one package under `out`, and pack it. Returns its path."""
    stage = out / f"stage-{suite}-{arch}"
    shutil.rmtree(stage, ignore_errors=True)
    python = PYTHONS[suite]
    packages(stage / HOME.relative_to("/"), arch, python)
    version = re.findall(r'__version__ = "([^"]+)"', (ROOT / "src/dappled/__init__.py").read_text(encoding="utf-8"))[0]
    command = Path("/usr/bin/dappled")
    settings = Path("/etc/dappled/dappled.toml")
    texts = service_files(Path("/usr"), Path("/etc"), command)
    texts[command] = COMMAND.format(home=HOME, python="/usr/bin/python3")
    texts[settings] = (ROOT / "systemd" / "dappled.toml").read_text(encoding="utf-8")
    texts[Path("/usr/share/doc/dappled/copyright")] = (ROOT / "LICENSE").read_text(encoding="utf-8")
    texts[HOME / "packaged"] = "This copy of dappled belongs to a Debian package.\n"  # see dappled.errors.PACKAGED
    for path, text in texts.items():
        put(stage / path.relative_to("/"), text, 0o755 if path == command else 0o644)
    size_kib = sum(path.stat().st_size for path in stage.rglob("*") if path.is_file()) // 1024
    minor = int(python.split(".")[1])
    control = CONTROL.format(
        version=version, suite=suite, arch=arch, size_kib=size_kib, python=python, next=f"3.{minor + 1}"
    )
    scripts = {"postinst": POSTINST, "prerm": PRERM, "postrm": POSTRM}
    for name, text in {"control": control, "conffiles": f"{settings}\n", **scripts}.items():
        put(stage / "DEBIAN" / name, text, 0o755 if name in scripts else 0o644)
    made = out / f"dappled_{version}+{suite}_{arch}.deb"
    call("dpkg-deb", "--root-owner-group", "-Zzstd", "--build", str(stage), str(made))
    shutil.rmtree(stage)
    return made


def packages(home: Path, arch: str, python: str) -> None:
    """The onboard lock with its hashes, and dappled itself, for another machine and Python; no tests."""
    uv = find_uv() or fetch_uv()
    there = ["--python-platform", PLATFORMS[arch], "--python-version", python, "--only-binary", ":all:", "--no-deps"]
    into = [*there, "--target", str(home), "--link-mode", "copy"]
    call(uv, "pip", "install", "-q", *into, "--require-hashes", "-r", str(ROOT / "requirements-onboard.lock"))
    wheels = home.parent / "wheels"
    call(uv, "build", "-q", "--wheel", *BUILD_LOCK, "--out-dir", str(wheels), str(ROOT))
    call(uv, "pip", "install", "-q", *into, str(next(wheels.glob("*.whl"))))
    shutil.rmtree(wheels)
    shutil.rmtree(home / "bin", ignore_errors=True)
    for tests in [path for path in home.rglob("tests") if path.is_dir()]:
        shutil.rmtree(tests, ignore_errors=True)


def put(path: Path, text: str, mode: int) -> None:
    """Write one file with its folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)


def call(*words: str) -> None:
    """Run a command that must succeed; its errors stand on stderr."""
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    sys.exit(main())
