"""What tests skip for lack of, the CI's own run gets: a skip must not hide that a promise was never looked at."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
ELSEWHERE = {
    "bash",  # part of every Debian
    "unshare",  # util-linux: part of every Debian
    "mount",  # as above, but not in the smallest root
    "umount",
}


def test_every_program_that_a_test_looks_for_is_had_from_debian_in_ci() -> None:
    sought = {
        name
        for path in (ROOT / "tests").rglob("*.py")
        if path != Path(__file__)
        for name in re.findall(r'which\("([^"]+)"\)', path.read_text("utf-8"))
    }
    assert "strace" in sought
    had = set(
        re.findall(r"command -v (\S+) >/dev/null (?:&& .*)?\|\| wanted", (ROOT / ".ci" / "packages").read_text("utf-8"))
    )
    assert sought - had - ELSEWHERE == set()
