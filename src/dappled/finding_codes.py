"""The code of each finding, made from the one list of them, `findings.toml`.

Type checkers and editors read the codes in `finding_codes.pyi`, which `tools/findings_page.py` writes.
"""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path

LIST = Path(__file__).with_name("findings.toml").read_text("utf-8")
# Codes alone: most starts of a command tell nothing, and reading the whole list takes 20 ms.
_CODES = re.findall(r'^\["(.+)"\]$', LIST, re.MULTILINE)
Code = StrEnum("Code", {code.replace(".", "_").upper(): code for code in _CODES}, module=__name__)
