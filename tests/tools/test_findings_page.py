"""The page of all findings is that of the table, and leads to pages that are there."""

from __future__ import annotations

from dappled.findings import words
from tests.made_pages import ROOT, assert_made


def test_the_page_of_all_findings_is_that_of_the_table() -> None:
    assert_made("findings.md", "findings_page")


def test_each_finding_leads_to_a_page_that_is_there() -> None:
    assert all((ROOT / "docs" / one.page.partition("#")[0]).exists() for one in words().values() if one.page)
