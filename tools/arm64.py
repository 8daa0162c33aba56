#!/usr/bin/env python3
"""Install the onboard set as a Raspberry Pi would (aarch64, glibc 2.36), print its size, and fly with it, emulated.

The second part needs root, mmdebstrap and qemu-user-static: in a Debian root for arm64 it runs `dappled doctor`, a
flight of a folder camera, and verifies a flight that this machine recorded; this machine verifies the one flown there.
The light fields of both machines are compared.
"""

from __future__ import annotations

import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

from bootstrap import ROOT, fetch_uv, find_uv

from dappled.drivers.mavlink import mavlink

LIMIT_MB = 350
PLATFORM, PYTHON = "aarch64-manylinux_2_36", "3.11"  # Raspberry Pi OS 12
SUITE = "bookworm"
DEBIAN = "python3,coreutils,libc-bin,dash,libstdc++6"
ARCHIVE = ROOT / "build" / "clean-room" / f"{SUITE}-arm64.tar"
WITHIN = 1e-5
"""The largest difference of two machines' slices that passes, relative to the largest value; 2e-7 was measured."""
STEP_S = 300
VERIFIED = "equal within 1e-06 of each frame's largest value"
PROCESSOR = "cortex-a72"
"""A Raspberry Pi 4's. QEMU's own choice has every extension, and QEMU 7.2 computes matrix products wrong with SME."""
PORT = 14570
BINFMT = Path("/proc/sys/fs/binfmt_misc")

COMPARE = """
import sys
import numpy as np
ours, theirs = (np.load(path) for path in sys.argv[1:3])
worst, which = 0.0, ""
for name in ours.files:
    a, b = ours[name], theirs[name]
    if a.dtype.kind in "fc" and a.size:
        assert a.shape == b.shape and a.dtype == b.dtype, name
        assert np.array_equal(np.isnan(a), np.isnan(b)), name
        here = float(np.nanmax(np.abs(a - b)) / (np.nanmax(np.abs(a)) or 1.0))
        worst, which = max((worst, which), (here, name))
print(worst, which)
"""
SETTINGS = """
[camera]
driver = "folder"
profile = "reference-36mm"
pickup = "{folder}/in"
[mask]
profile = "reference-5x5"
[record]
directory = "{folder}/flights"
min_free_mb = 1
[mavlink]
url = "udpin:127.0.0.1:{port}"
[publish]
slices = "ipc://{folder}/slices"
"""


def main() -> int:
    """Do both parts. The exit code is 1 where one fails."""
    uv = find_uv() or fetch_uv()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        packages = folder / "packages"
        size_mb = install(uv, packages)
        if size_mb > LIMIT_MB:
            print(f"more than the {LIMIT_MB} MB that onboard may take: move something to an extra", file=sys.stderr)
            return 1
        why = emulated() or arm_archive()
        if why:
            print(f"not run under emulation: {why}")
            return 0
        return fly(uv, folder, packages)


def install(uv: str, packages: Path) -> float:
    """The locked onboard set, by wheels alone, as tools/install.py leaves it; returns its size in MB."""
    wanted = ["--python-platform", PLATFORM, "--python-version", PYTHON, "--only-binary", ":all:", "--no-deps"]
    lock = ["--require-hashes", "-r", str(ROOT / "requirements-onboard.lock")]
    subprocess.run([uv, "pip", "install", "-q", *wanted, *lock, "--target", str(packages)], check=True)
    for tests in [path for path in packages.rglob("tests") if path.is_dir()]:
        shutil.rmtree(tests, ignore_errors=True)
    size_mb = sum(path.stat().st_size for path in packages.rglob("*") if path.is_file()) / 1e6
    count = len(list(packages.glob("*.dist-info")))
    print(f"aarch64, Python {PYTHON}: {count} onboard packages, all as wheels, {size_mb:.0f} MB installed")
    return size_mb


def emulated() -> str:
    """Why this machine can't run programs for arm64; "" where it can."""
    if os.geteuid() != 0:
        return "it needs root"
    if shutil.which("mmdebstrap") is None:
        return "it needs mmdebstrap"
    if not (BINFMT / "status").exists():
        subprocess.run(["mount", "-t", "binfmt_misc", "binfmt_misc", str(BINFMT)], check=False, capture_output=True)
    if (BINFMT / "register").exists() and not (BINFMT / "qemu-aarch64").exists():
        subprocess.run(["update-binfmts", "--enable", "qemu-aarch64"], check=False, capture_output=True)
    return (
        "" if (BINFMT / "qemu-aarch64").exists() else "the kernel has no qemu-aarch64 (binfmt_misc, qemu-user-static)"
    )


def fly(uv: str, folder: Path, packages: Path) -> int:
    """Doctor, a flight, a replay and a comparison in an arm64 root; 1 where one of them fails."""
    recorded, light_field = record_here(folder)
    subprocess.run([uv, "build", "-q", "--wheel", "--out-dir", str(folder), str(ROOT)], check=True)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([uv, "pip", "install", "-q", "--no-deps", "--target", str(packages), str(wheel)], check=True)
    with arm_root(folder) as root:
        (root / "opt").mkdir(exist_ok=True)
        packages.rename(root / "opt" / "dappled")
        work = root / "root" / "work"
        shutil.copytree(recorded, work / "recorded")
        frame = recorded / "frames" / "000000.dng"
        (work / "in").mkdir()
        (work / "dappled.toml").write_text(SETTINGS.format(folder="/root/work", port=PORT), encoding="utf-8")
        passed = [
            step(root, "doctor", "doctor", good=(0, 1), says="go       libgphoto2"),
            step(root, "settings", "config", "check", "dappled.toml"),
            folder_flight(root, work, frame),
            step(root, "verify of a flight recorded here", "replay", "recorded", "--verify", says=VERIFIED),
            verify_here(work),
            step(root, "decode", "decode", "recorded/frames/000000.dng", "--mask", "reference-5x5", "-o", "a.npz"),
        ]
        if all(passed):
            passed.append(compare(light_field, work / "a.npz"))
    return 0 if all(passed) else 1


def record_here(folder: Path) -> tuple[Path, Path]:
    """One simulated frame, recorded and decoded on this machine: its flight, and its light field."""
    dappled = str(ROOT / ".venv" / "bin" / "dappled")
    (folder / "here.toml").write_text(f'[record]\ndirectory = "{folder}/flights"\n', encoding="utf-8")
    run = [dappled, "run", "--simulate", "--frames", "1", "--config", str(folder / "here.toml")]
    subprocess.run(run, check=True, capture_output=True)
    (flight,) = (path for path in (folder / "flights").iterdir() if path.is_dir())
    decode = [dappled, "decode", "--mask", "reference-5x5", "-o", str(folder / "here.npz")]
    subprocess.run([*decode, str(flight / "frames" / "000000.dng")], check=True, capture_output=True)
    return flight, folder / "here.npz"


def arm_archive() -> str:
    """Make the archive of the root where it is missing; why it can't be made, or "".

    Its packages are not configured, which would take minutes under emulation: Python needs none of that.
    """
    if ARCHIVE.exists():
        return ""
    ARCHIVE.parent.mkdir(parents=True, exist_ok=True)
    part = ARCHIVE.with_suffix(".part")
    make = ["mmdebstrap", "--quiet", "--arch=arm64", "--format=tar", "--variant=extract", f"--include={DEBIAN}", SUITE]
    done = subprocess.run([*make, str(part)], check=False, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["mmdebstrap failed"])[-1]
        return f"no Debian root for arm64 could be made ({last})"
    part.rename(ARCHIVE)
    return ""


@contextmanager
def arm_root(folder: Path) -> Iterator[Path]:
    """An unpacked Debian root for arm64."""
    root = folder / "root"
    root.mkdir()
    subprocess.run(["tar", "-xf", str(ARCHIVE), "-C", str(root)], check=True)
    (root / "root" / "work").mkdir(parents=True)
    with ExitStack() as mounted:
        for kind, place in (("proc", root / "proc"), ("tmpfs", root / "dev" / "shm")):
            place.mkdir(parents=True, exist_ok=True)
            subprocess.run(["mount", "-t", kind, kind, str(place)], check=True)
            mounted.callback(subprocess.run, ["umount", "-l", str(place)], check=False)
        yield root


def in_root(root: Path, *words: str) -> subprocess.Popen[str]:
    """A dappled command in the arm64 root."""
    inside = [
        shutil.which("chroot") or "/usr/sbin/chroot",
        str(root),
        "/usr/bin/env",
        "-C",
        "/root/work",
        "/usr/bin/python3",
        "-m",
        "dappled",
        *words,
    ]
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": "/opt/dappled", "LANG": "C.UTF-8", "HOME": "/root"}
    environment["QEMU_CPU"] = PROCESSOR
    return subprocess.Popen(inside, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def step(root: Path, name: str, *words: str, good: tuple[int, ...] = (0,), says: str = "") -> bool:
    """Run one command there, and print how long it took; what it said only where it failed."""
    began = time.monotonic()
    running = in_root(root, *words)
    try:
        said, _ = running.communicate(timeout=STEP_S)
    except subprocess.TimeoutExpired:
        running.kill()
        said = running.communicate()[0] + f"\nno end within {STEP_S} s"
    passed = running.returncode in good and says in said
    print(f"arm64 {'passed' if passed else 'FAILED'}: {name}, {time.monotonic() - began:.1f} s")
    if not passed:
        print(said)
    return passed


def trigger_until(done: Callable[[], bool]) -> bool:
    """Send an autopilot's heartbeat and one and the same trigger, as ArduPilot repeats it, until it was taken."""
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    packets = [
        mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
        ),
        mavlink.MAVLink_camera_trigger_message(1_000_000, 1),
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:

        def sent() -> bool:
            for packet in packets:
                link.sendto(packet.pack(sender), ("127.0.0.1", PORT))
            return done()

        return within(sent)


def within(done: Callable[[], bool]) -> bool:
    """Wait for something, up to `STEP_S`."""
    deadline = time.monotonic() + STEP_S
    while not (there := done()) and time.monotonic() < deadline:
        time.sleep(0.5)
    return there


def folder_flight(root: Path, work: Path, frame: Path) -> bool:
    """A daemon with a folder camera: the autopilot's trigger, one file that appears, one frame safe and decoded."""
    daemon = in_root(root, "run", "--config", "dappled.toml")
    try:
        triggered = trigger_until(lambda: any(path.stat().st_size for path in (work / "flights").glob("*/shots.jsonl")))
        shutil.copy(frame, work / "in" / "shot.part")
        (work / "in" / "shot.part").rename(work / "in" / "shot.dng")
        within(lambda: bool(decoded(work)))
        daemon.send_signal(signal.SIGINT)
        said, _ = daemon.communicate(timeout=STEP_S)
    finally:
        daemon.kill()
    if not triggered or daemon.returncode:
        print(f"arm64 FAILED: flight of a folder camera\n{said}")
        return False
    (flight,) = (path.name for path in (work / "flights").iterdir() if path.is_dir())
    asked = [("report", "1 safe"), ("check", "consistent")]
    return all(
        step(root, f"folder camera: {verb}", "flight", verb, f"flights/{flight}", says=says) for verb, says in asked
    )


def decoded(work: Path) -> int:
    """How many frames the flights there have slices of."""
    count = 0
    for ledger in (work / "flights").glob("*/flight.sqlite"):
        with closing(sqlite3.connect(f"file:{ledger}?mode=ro", uri=True)) as reader, suppress(sqlite3.Error):
            count += reader.execute("SELECT count(*) FROM results").fetchone()[0]
    return count


def verify_here(work: Path) -> bool:
    """Whether this machine computes what the arm64 one recorded."""
    (flight,) = (path for path in (work / "flights").iterdir() if path.is_dir())
    asked = [str(ROOT / ".venv" / "bin" / "dappled"), "replay", str(flight), "--verify"]
    done = subprocess.run(asked, check=False, capture_output=True, text=True, timeout=STEP_S)
    passed = done.returncode == 0 and VERIFIED in done.stdout
    said = (done.stdout + done.stderr).strip()
    print(
        f"arm64 {'passed' if passed else 'FAILED'}: verify here of the flight recorded there: {said.splitlines()[-1:]}"
    )
    if not passed:
        print(said)
    return passed


def compare(ours: Path, theirs: Path) -> bool:
    """Whether the light fields of both machines agree within WITHIN of the largest value of each array."""
    python = str(ROOT / ".venv" / "bin" / "python")
    done = subprocess.run([python, "-c", COMPARE, str(ours), str(theirs)], check=True, capture_output=True, text=True)
    number, which = done.stdout.split()
    worst = float(number)
    passed = worst <= WITHIN
    word = "passed" if passed else "FAILED"
    print(f"arm64 {word}: largest difference of the light fields {worst:.1e} ({which}, relative)")
    return passed


if __name__ == "__main__":
    sys.exit(main())
