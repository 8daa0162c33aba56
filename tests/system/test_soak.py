"""Two minutes of the soak: everything goes wrong, and every shot is accounted for."""

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest

from tests.soak import soak
from tests.soak.supervised import Resources


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.timeout(400)
def test_the_counts_balance_after_two_minutes_of_trouble() -> None:
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        told: list[str] = []
        account = soak.soak(soak.SoakPlan(seconds=120, seed=4), Path(folder), told.append)
        log = (Path(folder) / "daemon.log").read_text(encoding="utf-8", errors="replace")
    assert account.problems == [], "\n".join([*account.problems, *told, log[-5000:]])
    assert account.accepted <= account.shots <= account.asked  # unanswered requests may have been shots
    assert account.safe > account.asked / 3
    assert account.shots == account.safe + account.failed
    assert sum(account.faults.values()) >= 15


def test_growth_is_told_with_numbers() -> None:
    before = Resources(100.0, 20, 10, 2)
    assert before.grown(Resources(125.0, 23, 12, 2)) == []
    assert before.grown(Resources(127.0, 24, 13, 3)) == [
        "memory grew from 100 to 127 MB",
        "files grew from 20 to 24",
        "threads grew from 10 to 13",
        "children grew from 2 to 3",
    ]
