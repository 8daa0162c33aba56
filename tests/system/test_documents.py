"""Every command that the documents print runs, as printed, and ends well; limits that they state are the code's."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from dappled.config.settings import CameraSettings, PublishSettings
from dappled.daemon.console import access, connection, feed
from dappled.daemon.live_settings import CHANGES_IN_FLIGHT
from dappled.daemon.pipeline import repeats
from tests.system.conftest import Flown
from tests.system.documents import ROOT, Stage, commands, stage

DOCUMENTS = [page for page in sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")]) if commands(page)]
LONG = (
    "README.md",
    "decoding.md",
    "maps.md",
    "operating.md",
    "products.md",
    "wire.md",
)  # their commands cost a core half a minute or more


def test_the_readme_s_first_screen_says_what_one_gains_and_what_it_costs() -> None:
    """Before the first command: what a person gains, one picture of it, and the ground in a pixel."""
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    first = readme.split("\n## ")[0]
    gain = first.split("**")[1]
    for words in (
        "One press of the shutter",
        "many views",
        "refocus after landing",
        "depth from one camera",
        "resolution",
    ):
        assert words in " ".join(gain.split()), words
    (picture,) = re.findall(r"!\[[^]]{40,}\]\((docs/pictures/\S+)\)", first)
    assert (ROOT / picture).stat().st_size > 50_000
    assert "```" not in first
    assert first.index(picture) < first.index("cm per pixel")
    assert len(readme.split()) <= 900


@pytest.fixture(scope="module")
def on_stage(tmp_path_factory: pytest.TempPathFactory, flown: Flown) -> Iterator[Stage]:
    with tempfile.TemporaryDirectory(prefix="doc-") as short:
        yield stage(tmp_path_factory.mktemp("d"), Path(short), flown.flight)


def test_commands_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "Text `dappled x`.\n\n    dappled mask table   # 4\n\n```sh\n$ dappled flight list \\\n  --json\nls\n```\n",
        encoding="utf-8",
    )
    assert commands(page) == ["dappled flight list    --json", "dappled mask table"]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize(
    "document",
    [pytest.param(page, id=page.name, marks=[pytest.mark.long] if page.name in LONG else []) for page in DOCUMENTS],
)
def test_the_documents_commands_run(document: Path, on_stage: Stage) -> None:
    failures = on_stage.all_fail(commands(document))
    assert not failures, "\n".join(failures)


NUMBERS = {
    "console.md": [
        f"At most {feed.PAGES} pages can be open; each has a queue of {feed.WAITING} events",
        f"One address may have {connection.PER_ADDRESS} connections, all addresses together {connection.CONNECTIONS}",
        (
            f"no whole request within {connection.REQUEST_S:.0f} seconds is closed, and one whose reader stops "
            f"reading, after {connection.UNREAD_S:.0f}"
        ),
        f"JSON, at most {access.BODY_BYTES // 1024} kB",
    ],
    "mavlink.md": [
        (
            f"comes twice over one link within {repeats.SAME_LINK_NS / 1e9:g} s, or over another link within "
            f"{repeats.OTHER_LINK_NS / 1e9:g} s"
        ),
        (
            f"within {repeats.RETRY_NS / 1e9:g} s of the last such message, and within "
            f"{repeats.RETRY_LIMIT_NS / 1e9:g} s"
        ),
        f"the sender itself marks the message as a repeat, and the limit is {repeats.CONFIRMED_RETRY_NS / 1e9:g} s",
        f"within {repeats.TRIGGER_NS / 1e9:g} s of a shot's first message",
        f"within {repeats.ECHO_NS / 1e9:g} s of the",
    ],
    "operating.md": [
        f"a millisecond instead of {CameraSettings().latency_sigma_ms:g}",
        "the settings that can change in flight ("
        + ", ".join(f"`{table}.{key}`" for table, key in sorted(CHANGES_IN_FLIGHT, reverse=True))
        + ")",
    ],
    "wire.md": [f"`publish.high_water_mark` messages ({PublishSettings().high_water_mark})"],
}


@pytest.mark.parametrize("name", NUMBERS)
def test_documents_say_the_numbers_that_hold(name: str) -> None:
    text = " ".join((ROOT / "docs" / name).read_text(encoding="utf-8").split())
    assert [sentence for sentence in NUMBERS[name] if sentence not in text] == []
