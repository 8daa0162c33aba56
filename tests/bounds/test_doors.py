"""Hostile inputs at every door, in a process with a memory cap: each ends in success or in one sentence."""

from __future__ import annotations

import random
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from tests.bounds import samples

SEED = 17
QUICK, SLOW = 2, 40  # mutations for each door
# Bombs that a door reads, in bounded memory: it lists the lines that are no shots, skips bytes that are no telemetry,
# passes over parts that it needs not, or takes a mask that is all black.
HARMLESS = {
    *(f"journal/b-{name}.jsonl" for name in ("deep", "long", "frame", "big")),
    *(f"telemetry/b-{name}.tlog" for name in ("stamps", "lengths")),
    *(f"lfp/b-{name}.lfp" for name in ("deep", "wide")),
    *(f"{door}/b-rows.tif" for door in ("tiff", "mask-tiff", "terrain", "base-map")),
    *(f"{door}/b-strip.tif" for door in ("terrain", "base-map")),
    "mask-png/b-zeros.png",
}


@pytest.fixture(scope="session")
def honest(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return samples.honest(tmp_path_factory.mktemp("honest"))


def opened(folder: Path) -> dict[str, str]:
    """What became of each input, by door and name; one that ended the process, too."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.bounds.doors", folder], capture_output=True, text=True, check=False,
        cwd=Path(__file__).parents[2], timeout=3000,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    found = {one[2:]: other[2:] for one, other in zip(lines[::2], lines[1::2], strict=False)}
    if done.returncode:
        victim = lines[-1][2:] if lines and lines[-1].startswith("> ") else "the start"
        found[victim] = f"unexpected: the process ended with {done.returncode}: {done.stderr[-2000:]}"
    return found


def expect_sentences(found: dict[str, str], count: int) -> None:
    assert not {name: outcome for name, outcome in found.items() if outcome.startswith("unexpected")}
    assert len(found) == count
    outcomes = Counter((name.partition("/")[0], outcome.partition(":")[0]) for name, outcome in found.items())
    for (door, outcome), number in sorted(outcomes.items()):
        sys.stdout.write(f"{door} {outcome} {number}\n")  # for pytest -rP


def lay_out(honest: dict[str, Path], folder: Path, mutations: int, door: str = "") -> int:
    """Make the folder that `doors` opens: an honest input, and mutations. Returns how many inputs there are."""
    chance = random.Random(SEED)  # noqa: S311  # noise, no secret
    for name in [door] if door else honest:
        place, source = folder / name, honest[name]
        place.mkdir(parents=True)
        (shutil.copytree if source.is_dir() else shutil.copy)(source, place / f"0000{source.suffix}")
        for number in range(1, mutations + 1):
            samples.mutated(source, place / f"m{number:05d}{source.suffix}", chance)
    return mutations * (1 if door else len(honest))


@pytest.mark.slow
@pytest.mark.timeout(600)  # it starts a dozen processes, and others may keep the machine busy
def test_bombs_and_a_few_mutations_at_every_door(honest: dict[str, Path], tmp_path: Path) -> None:
    count = lay_out(honest, tmp_path / "in", QUICK)
    (tmp_path / "bombs").mkdir()
    refused = []
    for door, name, made in samples.bombs(honest, tmp_path / "bombs"):
        made.rename(tmp_path / "in" / door / f"b-{name}{made.suffix}")
        refused.append(f"{door}/b-{name}{made.suffix}")
    found = opened(tmp_path / "in")
    expect_sentences(found, count + len(refused))
    assert {name for name in refused if found[name] == "ok"} <= HARMLESS


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("door", samples.DOORS)
def test_many_mutations_of_one_door(honest: dict[str, Path], tmp_path: Path, door: str) -> None:
    count = lay_out(honest, tmp_path / "in", SLOW // 8 if door == "h5" else SLOW, door)
    expect_sentences(opened(tmp_path / "in"), count)
