"""Print the documents' page of the command line, as Markdown: what each verb says with --help."""

from __future__ import annotations

import io
import os
import sys
from contextlib import redirect_stdout, suppress

from dappled.cli.command_line import read
from dappled.cli.table import VERBS


def page() -> str:
    """The page."""
    os.environ["COLUMNS"] = "100"
    parts = ["# The command line", "", "Made from the verbs: `dappled VERB --help` says the same.", ""]
    for path in VERBS:
        said = io.StringIO()
        with redirect_stdout(said), suppress(SystemExit):
            read([*path.split(), "--help"])
        parts += [f"## dappled {path}", "", "```text", said.getvalue().rstrip(), "```", ""]
    return "\n".join(parts)


if __name__ == "__main__":
    sys.stdout.write(page())
