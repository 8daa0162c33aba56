"""One version everywhere: what `dappled.__version__` says stands in the citation and in the documents' file names."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import dappled

ROOT = Path(__file__).parents[2]


def test_the_citation_is_of_this_version() -> None:
    text = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.+)$", text, re.MULTILINE) == [dappled.__version__]


@pytest.mark.parametrize("page", ["README.md", "docs/operating.md"])
def test_packages_are_named_by_this_version(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    named = re.findall(r"dappled[-_](\d[\w.]*?)(?:\+\w+_\w+\.deb|-py3-none-any\.whl)", text)
    assert set(named) == {dappled.__version__}


def test_the_container_copies_what_is_there() -> None:
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    copied = [name for line in re.findall(r"^COPY (?!--from)(.+) \S+$", text, re.MULTILINE) for name in line.split()]
    assert "requirements-onboard.lock" in copied
    assert [name for name in copied if not (ROOT / name).exists()] == []
