"""The plug is pulled at random times; what a station outside of the machine heard is compared with the folder."""

from __future__ import annotations

import hashlib
import json
import os
import random
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from dappled.mocks.body.body import BodyOptions, pattern
from tests.machine.conftest import FLIGHTS, Scene
from tests.machine.uml import HERE, copy

pytestmark = [pytest.mark.machine, pytest.mark.alone, pytest.mark.timeout(7200)]
FEW = 5
MANY = int(os.environ.get("CUTS", str(FEW)))
SEED = int(os.environ.get("SEED", "46"))
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


def heard(scene: Scene) -> Heard:
    """Written down while the machine does nothing more."""
    now_s = time.monotonic()
    it = scene.station
    it.catch_up()
    return Heard(now_s, tuple(it.accepted_s), tuple(it.refused_s), frozenset(it.captured), scene.body.releases)


def ask_until(scene: Scene, chance: random.Random, end_s: float) -> None:
    """Requests now and then, some before the camera is ready again."""
    while (left_s := end_s - time.monotonic()) > 0:
        scene.station.request()
        time.sleep(min(left_s, chance.uniform(0.05, 1.0)))  # the time of a request is what is drawn here


def compared(scene: Scene, known: Heard, at_cut: str, slack_s: float) -> dict[str, Any]:
    """Start the service on the disk that the cut left; check its books. `at_cut`: the flight's folder; `slack_s`: how
    much longer than the report says the last shots and refusals may be on their way to the disk."""
    scene.machine.run("systemctl start dappled && systemctl stop dappled", timeout_s=300)
    book: dict[str, Any] = json.loads(
        scene.machine.run(f"dappled flight report --json {FLIGHTS}/{at_cut} || true", timeout_s=300)
    )
    assert book["balanced"] is None  # it says that it can't know, never that the counts agree
    within = book["cut_short"]["facts"]
    for count, times, lost_s in (
        (book["wishes"], known.accepted_s, within["shots_s"]),
        (book["refused"], known.refused_s, within["refusals_s"]),
    ):
        assert count >= sum(at < known.cut_s - lost_s - slack_s for at in times), (count, lost_s, known, book)
    listed = scene.machine.run(f"cd {FLIGHTS}/{at_cut}/frames && sha256sum *.cr2 2>/dev/null || true").split()
    recorded = {int(name.partition(".")[0]): found for found, name in zip(listed[::2], listed[1::2], strict=True)}
    assert known.captured <= set(recorded)
    pictures = {hashlib.sha256(pattern(number, SMALL)).hexdigest() for number in range(1, known.releases + 1)}
    assert set(recorded.values()) <= pictures
    assert len(set(recorded.values())) == len(recorded)
    return {
        "accepted": max(len(known.accepted_s) - book["wishes"], 0),
        "refused": max(len(known.refused_s) - book["refused"], 0),
    }


@pytest.mark.parametrize(
    ("cuts", "slack_s"),
    [
        pytest.param(
            FEW, 2.0, marks=pytest.mark.slow, id="few"
        ),  # a machine that stands still for a second is no failure
        pytest.param(MANY, 0.0, marks=pytest.mark.long, id="many"),
    ],
)
def test_a_power_cut_takes_nothing_that_was_announced_and_the_books_say_what_they_lack(
    scene: Callable[..., Scene], tmp_path: Path, table: Callable[[str, object], None], cuts: int, slack_s: float
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
    flown.begin()
    at_cut = flown.machine.run(f"ls {FLIGHTS} | grep Z- | tail -n 1").strip()
    chance = random.Random(SEED)  # noqa: S311 (when a plug is pulled)
    known = []
    for number in range(cuts - 1):
        ask_until(flown, chance, time.monotonic() + chance.uniform(1, 6))
        with flown.machine.halted():
            known.append(heard(flown))
            flown.machine.as_cut(tmp_path / f"cut{number}", chance)
    ask_until(flown, chance, time.monotonic() + chance.uniform(1, 6))
    with flown.machine.halted():
        known.append(heard(flown))
        flown.machine.as_cut(tmp_path / f"cut{cuts - 1}", chance)
        flown.machine.cut()
    copy(tmp_path / f"cut{cuts - 1}", disk)
    flown.body.fault("unplug")  # its TCP link hears nothing of a cut; and what is compared needs no camera
    flown.machine.start()
    lost = []
    for number in [cuts - 1, *range(cuts - 1)]:
        place = "ubdc"
        if number == cuts - 1:
            place = "ubdb"
        else:
            copy(tmp_path / f"cut{number}", slot)
            (tmp_path / f"cut{number}").unlink()
        flown.machine.run(f"blockdev --flushbufs /dev/{place}; mount /dev/{place} {FLIGHTS}")
        lost.append(compared(flown, known[number], at_cut, slack_s))
        flown.machine.run(f"umount {FLIGHTS}")
    table("power cuts; announced frames lost or changed", f"{cuts}; 0 of {len(known[-1].captured)}")
    for what in ("accepted", "refused"):
        found = [one[what] for one in lost]
        table(f"{what} and not in the books: cuts, most in one", f"{sum(map(bool, found))}, {max(found)}")
