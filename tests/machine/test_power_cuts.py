"""The plug is pulled at random times; what a station outside of the machine heard is compared with the folder."""

from __future__ import annotations

import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from dappled.mocks.body.body import BodyOptions, SimulatedBody, pattern
from dappled.mocks.simulation import free_port
from tests.flight.ext4 import an_image, mount, unmount
from tests.machine.conftest import FLIGHTS, Scene
from tests.machine.uml import HERE, Station, copy, station

pytestmark = [pytest.mark.machine, pytest.mark.alone, pytest.mark.timeout(7200)]
FEW = 5
CUTS = int(os.environ.get("CUTS", str(FEW)))
SEED = int(os.environ.get("SEED", "46"))
SLACK_S = 2.0  # a host that stands still for a second is no failure
SMALL = 300_000
DISK_BYTES = 1 << 30


@dataclass(frozen=True)
class Heard:
    """What the station had heard when the plug was pulled, times by this machine's clock."""

    cut_s: float
    accepted_s: tuple[float, ...]
    refused_s: tuple[float, ...]
    captured: frozenset[int]
    releases: int

    def while_running(self, stood: Sequence[tuple[float, float]]) -> Heard:
        """With times of a clock that stands while the machine does: from one of `stood` to the other it writes
        nothing."""

        def at(moment_s: float) -> float:
            return moment_s - sum(min(end_s, moment_s) - began_s for began_s, end_s in stood if began_s < moment_s)

        accepted_s, refused_s = (tuple(map(at, times)) for times in (self.accepted_s, self.refused_s))
        return replace(self, cut_s=at(self.cut_s), accepted_s=accepted_s, refused_s=refused_s)


def heard(it: Station, body: SimulatedBody) -> Heard:
    """Written down while the machine does nothing more."""
    now_s = time.monotonic()
    it.catch_up()
    return Heard(now_s, tuple(it.accepted_s), tuple(it.refused_s), frozenset(it.captured), body.releases)


def ask_until(station: Station, chance: random.Random, end_s: float) -> None:
    """Requests now and then, some before the camera is ready again."""
    while (left_s := end_s - time.monotonic()) > 0:
        station.request()
        time.sleep(min(left_s, chance.uniform(0.05, 1.0)))  # the time of a request is what is drawn here


def compared(run: Callable[[str], str], flight: str, known: Heard, slack_s: float = 0) -> dict[str, int]:
    """Check the books of the disk that the cut left, on which dappled has run since; how much they lack. `run` has a
    command run where the disk is; `flight`: the folder at the cut; `slack_s`: how much longer than the report says the
    last shots and refusals may be on their way to the disk."""
    book: dict[str, Any] = json.loads(run(f"dappled flight report --json {flight} || true"))
    assert book["balanced"] is None  # it says that it can't know, never that the counts agree
    within = book["cut_short"]["facts"]
    for count, times, lost_s in (
        (book["wishes"], known.accepted_s, within["shots_s"]),
        (book["refused"], known.refused_s, within["refusals_s"]),
    ):
        ages_s = [known.cut_s - at for at in times]
        assert count >= sum(age_s > lost_s + slack_s for age_s in ages_s), (count, lost_s, ages_s[-40:])
    listed = run(f"cd {flight}/frames && sha256sum *.cr2 2>/dev/null || true").split()
    recorded = {int(name.partition(".")[0]): found for found, name in zip(listed[::2], listed[1::2], strict=True)}
    assert known.captured <= set(recorded)
    pictures = {hashlib.sha256(pattern(number, SMALL)).hexdigest() for number in range(1, known.releases + 1)}
    assert set(recorded.values()) <= pictures
    assert len(set(recorded.values())) == len(recorded)
    return {
        "accepted": max(len(known.accepted_s) - book["wishes"], 0),
        "refused": max(len(known.refused_s) - book["refused"], 0),
    }


@pytest.mark.long
def test_a_power_cut_takes_nothing_that_was_announced_and_the_books_say_what_they_lack(
    scene: Callable[..., Scene], tmp_path: Path, table: Callable[[str, object], None]
) -> None:
    """All but the last cut are copies of the disk, as each would have left it; after the last the machine starts."""
    disk, slot = tmp_path / "flights", tmp_path / "slot"
    for one in (disk, slot):
        with open(one, "wb") as file:
            file.truncate(DISK_BYTES)
    subprocess.run(["/usr/sbin/mkfs.ext4", "-q", disk], check=True)
    flown = scene(body=BodyOptions(picture=f"pattern:{SMALL}:cr2", bind=HERE, delay_s=0.2), disks=(disk, slot))
    flown.configure()
    flown.machine.run(f"mount /dev/ubdb {FLIGHTS} && chown dappled: {FLIGHTS}")
    # The machine's clock goes on while it is stopped for a copy of its disk: longer than the watchdog waits, at times.
    unit = "/run/systemd/system/dappled.service.d"
    flown.machine.run(f"mkdir -p {unit} && printf '[Service]\\nWatchdogSec=600\\n' >{unit}/copied.conf")
    flown.machine.run("systemctl daemon-reload")
    flown.begin()
    at_cut = flown.machine.run(f"ls {FLIGHTS} | grep Z- | tail -n 1").strip()
    chance = random.Random(SEED)  # noqa: S311 (when a plug is pulled)
    known: list[Heard] = []
    stood: list[tuple[float, float]] = []
    for number in range(CUTS - 1):
        ask_until(flown.station, chance, time.monotonic() + chance.uniform(1, 6))
        began_s = time.monotonic()
        with flown.machine.halted():
            known.append(heard(flown.station, flown.body).while_running(stood))
            flown.machine.as_cut(tmp_path / f"cut{number}", chance)
        stood.append((began_s, time.monotonic()))
    assert flown.shown("NRestarts") == "0"  # all cuts are of one flight
    table("the machine stood for a copy of its disk: most at once, s", round(max(b - a for a, b in stood), 1))
    ask_until(flown.station, chance, time.monotonic() + chance.uniform(1, 6))
    with flown.machine.halted():
        known.append(heard(flown.station, flown.body).while_running(stood))
        flown.machine.as_cut(tmp_path / f"cut{CUTS - 1}", chance)
        flown.machine.cut()
    copy(tmp_path / f"cut{CUTS - 1}", disk)
    flown.body.fault("unplug")  # its TCP link hears nothing of a cut; and what is compared needs no camera
    flown.machine.start()
    lost = []
    for number in [CUTS - 1, *range(CUTS - 1)]:
        place = "ubdc"
        if number == CUTS - 1:
            place = "ubdb"
        else:
            copy(tmp_path / f"cut{number}", slot)
            (tmp_path / f"cut{number}").unlink()
        flown.machine.run(f"blockdev --flushbufs /dev/{place}; mount /dev/{place} {FLIGHTS}")
        flown.machine.run("systemctl start dappled && systemctl stop dappled", timeout_s=300)
        run = partial(flown.machine.run, timeout_s=300)
        lost.append(compared(run, f"{FLIGHTS}/{at_cut}", known[number]))
        flown.machine.run(f"umount {FLIGHTS}")
    table("power cuts; announced frames lost or changed", f"{CUTS}; 0 of {len(known[-1].captured)}")
    for what in ("accepted", "refused"):
        found = [one[what] for one in lost]
        table(f"{what} and not in the books: cuts, most in one", f"{sum(map(bool, found))}, {max(found)}")


@contextmanager
def stopped(pid: int) -> Iterator[None]:
    """No thread of this process does one step meanwhile."""
    os.kill(pid, signal.SIGSTOP)
    try:
        while any(
            one.read_text("utf-8", "replace").rpartition(")")[2].split()[0] != "T"
            for one in Path(f"/proc/{pid}/task").glob("*/stat")
        ):
            time.sleep(0.001)  # a call of the kernel is finished first
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


@pytest.mark.slow
def test_nor_does_one_of_a_disk_of_this_host(tmp_path: Path) -> None:
    """Where no machine is: the daemon as a process, its flights on an ext4 in a file. What stands in the file while the
    daemon is stopped is what a cut leaves on a disk without a cache of its own."""
    chance = random.Random(SEED)  # noqa: S311 (when a plug is pulled)
    body_options = BodyOptions(picture=f"pattern:{SMALL}:cr2", delay_s=0.2)
    place, after = ("127.0.0.1", free_port()), tmp_path / "after"
    path = os.environ | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    run = partial(subprocess.check_output, shell=True, text=True, env=path)  # noqa: S604 (its words are ours)
    command = [sys.executable, "-m", "dappled", "run", "--config"]
    known: list[Heard] = []
    with an_image(tmp_path, 128) as disk, SimulatedBody.start(body_options) as body, station(place) as heard_here:
        settings, later = tmp_path / "dappled.toml", tmp_path / "later.toml"
        for file, flights in ((settings, disk.mounted), (later, after)):
            file.write_text(
                f'[camera]\nport = "{body.port}"\n[mavlink]\nurl = "udpout:{place[0]}:{place[1]}"\n'
                f'[record]\ndirectory = "{flights}/flights"\nmin_free_mb = 1\n',
                encoding="utf-8",
            )
        with subprocess.Popen([*command, settings], cwd=tmp_path, stderr=subprocess.DEVNULL) as daemon:
            try:
                heard_here.until(lambda it: it.heartbeats, "a heartbeat")
                (folder,) = [one.name for one in (disk.mounted / "flights").iterdir() if "Z-" in one.name]
                for number in range(FEW):
                    ask_until(heard_here, chance, time.monotonic() + chance.uniform(1, 6))
                    with stopped(daemon.pid):
                        known.append(heard(heard_here, body))
                        disk.cut(f"cut{number}")
            finally:
                daemon.kill()
        body.fault("unplug")
        for number, one in enumerate(known):
            mount(tmp_path / f"cut{number}", after)
            try:
                subprocess.run([*command, later, "--for", "0"], cwd=tmp_path, check=True, capture_output=True)
                compared(run, f"{after}/flights/{folder}", one, SLACK_S)
            finally:
                unmount(after)
    assert known[-1].captured
