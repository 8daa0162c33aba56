"""Write what is made from `findings.toml`: docs/findings.md (what can be found, in words, what to do, and where more is
said), and `finding_codes.pyi`, the codes for type checkers and editors."""

from __future__ import annotations

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
wire and `--json` hold these; the console, `dappled status`, STATUSTEXT, metrics and the log show them in these words,
worst first, then newest. A *note* needs no action. A *caution* costs something. With a *stop* no frame, or no good one,
is made. Words in braces are facts; one with `?` is left out where it is unknown. A fact may be what led to the finding:
another finding, or an error `{error, errno, path, said}`. A finding ends when the part that reported it sees that it is
over. A code that is a link leads to the page that says more.

`python tools/findings_page.py` makes this page from the table in the code.
"""
TITLES = "| code | level | what was found | what to do |\n| --- | --- | --- | --- |"


def page() -> str:
    """The page as it should be."""
    rows = []
    for code, each in words().items():
        name = f"[`{code.value}`]({each.page})" if each.page else f"`{code.value}`"
        rows.append(f"| {name} | {each.level.word} | {each.sentence} | {each.remedy} |")
    return "\n".join([HEAD, TITLES, *rows, ""])


def stub() -> str:
    """The list of codes as it should be."""
    return STUB_HEAD + "".join(f'    {code.name} = "{code.value}"\n' for code in words())


if __name__ == "__main__":
    STUB.write_text(stub(), encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")
