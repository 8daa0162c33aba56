"""The code of each finding, made from the one list of them, `findings.toml`.

Type checkers and editors read the codes in `finding_codes.pyi`, which `tools/findings_page.py` writes.
"""

from __future__ import annotations

import tomllib
from enum import StrEnum
from importlib import resources

TABLE = tomllib.loads(resources.files("dappled").joinpath("findings.toml").read_text("utf-8"))
Code = StrEnum("Code", {code.replace(".", "_").upper(): code for code in TABLE}, module=__name__)
