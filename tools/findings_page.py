"""Write what is made from `findings.toml`: docs/findings.md (what can be found, in words, what to do, and where more is
said), and `finding_codes.pyi`, the codes for type checkers and editors."""

from __future__ import annotations

from itertools import groupby
from pathlib import Path

from dappled.findings import words

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "findings.md"
STUB = ROOT / "src" / "dappled" / "finding_codes.pyi"
STUB_HEAD = '''"""The codes of `findings.toml`, written by `python tools/findings_page.py`."""

from enum import StrEnum

LIST: str

class Code(StrEnum):
    """What can be found. The part before the dot names what it is about; `findings.toml` has the words."""

'''
HEAD = """# What can be found

Whatever a person may have to know is a finding: a code, a level, what it is about, and facts. Health record, ledger,
wire and `--json` hold these; the console, `dappled status`, the pilot's messages, the metrics and the log show them in
these words, worst first, then newest. A *note* stands in the way of nothing. Above it nothing is "go": a *caution*
costs something, and with a *stop* no good frame is made, or none is taken. Words in braces are facts; one with `?` is
left out where it is unknown. A finding ends when the part that reported it sees that it is over.

This page is made from the table in the code: `python tools/findings_page.py`.
"""
TITLES = "| code | level | what was found | what to do |\n| --- | --- | --- | --- |"


def page() -> str:
    """The page as it should be."""
    parts = [HEAD]
    for about, each in groupby(words().items(), lambda one: one[0].value.partition(".")[0]):
        rows = [f"## {about}\n\n{TITLES}"]
        for code, told in each:
            more = f"{' ' if told.remedy else ''}([more]({told.page}))" if told.page else ""
            rows.append(f"| `{code.value}` | {told.level.word} | {told.sentence} | {told.remedy}{more} |")
        parts.append("\n".join(rows) + "\n")
    return "\n".join(parts)


def stub() -> str:
    """The list of codes as it should be."""
    return STUB_HEAD + "".join(f'    {code.name} = "{code.value}"\n' for code in words())


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")
