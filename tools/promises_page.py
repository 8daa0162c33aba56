"""Write the table of docs/security.md from tests/promises.toml: what is promised, and the test that attacks it."""

from __future__ import annotations

import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "security.md"
BEGIN, END = "<!-- promises: python tools/promises_page.py -->\n", "<!-- end of promises -->\n"


def page() -> str:
    """The page as it should be."""
    told = tomllib.loads((ROOT / "tests" / "promises.toml").read_text("utf-8"))["promise"]
    rows = [f"| {one['that']} | `{one['test']}` |\n" for one in told]
    before, _, rest = PAGE.read_text("utf-8").partition(BEGIN)
    return f"{before}{BEGIN}\n| promise | test |\n| --- | --- |\n{''.join(rows)}\n{END}{rest.partition(END)[2]}"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
