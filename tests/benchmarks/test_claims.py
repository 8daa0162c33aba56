"""What the documents say about speed is measured: the section names the benchmark, or the page with the figures."""

from __future__ import annotations

import re

from tests.benchmarks import FOLDER

ROOT = FOLDER.parent
COST = re.compile(r"CPU-s|CPU time|CPU seconds|processor time|[GM]B/s|(?:times|twice|half|third) as (?:fast|long)\b")
NAMED = re.compile(r"benchmarks/(\w+\.(?:py|toml|json))")
SOURCE = re.compile(r"benchmarks/\w+\.py|performance\.md")
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
# An autopilot's clock.
NOT_OURS = ("times as fast as this machine's",)


def test_a_section_that_tells_a_cost_tells_where_it_was_measured() -> None:
    for page in PAGES:
        if page.name == "performance.md":
            continue
        for section in re.split(r"^(?=#+ )", page.read_text(encoding="utf-8"), flags=re.MULTILINE):
            said = section
            for words in NOT_OURS:
                said = said.replace(words, "")
            found = COST.search(said)
            assert found is None or SOURCE.search(said), f"{page.name}, {section.splitlines()[0]}: {found.group()}"


def test_benchmarks_that_are_named_are_there() -> None:
    named = [(page.name, name) for page in PAGES for name in NAMED.findall(page.read_text(encoding="utf-8"))]
    assert named
    assert [pair for pair in named if not (FOLDER / pair[1]).is_file()] == []
