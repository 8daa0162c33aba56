"""Every command that the documents print runs, as printed, and ends well."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.documents import ROOT, Stage, commands, stage

DOCUMENTS = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])


@pytest.fixture(scope="module")
def on_stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    with tempfile.TemporaryDirectory(prefix="doc-") as short, stage(tmp_path_factory.mktemp("d"), Path(short)) as ready:
        yield ready


def test_commands_are_found(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "Text `dappled x`.\n\n    dappled mask table   # 4\n\n```sh\n$ dappled flight list \\\n  --json\nls\n```\n",
        encoding="utf-8",
    )
    assert commands(page) == ["dappled flight list    --json", "dappled mask table"]


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_the_documents_commands_run(document: Path, on_stage: Stage) -> None:
    failures = on_stage.all_fail(commands(document))
    assert not failures, "\n".join(failures)
