#!/usr/bin/env python3
"""Run the notebooks of docs/notebooks from the top, each in an empty folder, as a reader would.

python tools/notebooks.py                 run all of them; the exit code is 1 where a cell fails
python tools/notebooks.py --write         also keep what they print and draw, in pictures made small
python tools/notebooks.py NAME...         these only
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import nbformat
from bootstrap import ROOT
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from PIL import Image

FOLDER = ROOT / "docs" / "notebooks"
CELL_S = 600
INLINE = "module://matplotlib_inline.backend_inline"
QUALITY = 70  # of the JPEG pictures that are kept


def main() -> int:
    """Run the notebooks; 1 where a cell fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help="as first-light-field; default: all")
    parser.add_argument("--write", action="store_true", help="keep the outputs in the notebooks")
    given = parser.parse_args()
    paths = [FOLDER / f"{name}.ipynb" for name in given.names] or sorted(FOLDER.glob("*.ipynb"))
    failed = False
    for path in paths:
        began = time.monotonic()
        problem = run(path, write=given.write)
        print(f"{path.name}: {problem or 'ran'}, {time.monotonic() - began:.0f} s", flush=True)
        failed |= bool(problem)
    return 1 if failed else 0


def run(path: Path, *, write: bool) -> str:
    """Run one notebook with this Python and the commands beside it. Returns what went wrong, or ""."""
    notebook: Any = nbformat.read(path, as_version=4)
    commands = Path(sys.executable).parent
    path_there = f"{commands}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path_there, "COLUMNS": "120", "MPLBACKEND": INLINE}
    with tempfile.TemporaryDirectory(prefix="nb-") as folder:  # short: sockets of the flight have names below it
        client = NotebookClient(
            notebook,
            timeout=CELL_S,
            startup_timeout=CELL_S,
            kernel_name="python3",
            extra_arguments=["--log-level=ERROR"],
            resources={"metadata": {"path": folder}},
        )
        try:
            client.execute(env=environment)
        except CellExecutionError as error:
            return f"a cell failed: {error}"
    if write:
        nbformat.write(shrunk(notebook, folder), path)
    return ""


def shrunk(notebook: Any, folder: str) -> Any:
    """The notebook with JPEG pictures instead of PNG, without progress bars and the name of the folder it ran in."""
    for number, cell in enumerate(notebook.cells):
        cell.metadata.pop("execution", None)
        cell["id"] = f"cell-{number}"
        for output in cell.get("outputs", ()):
            if "text" in output:
                output["text"] = plain(output["text"]).replace(f"{folder}/", "")
            data = output.get("data", {})
            if "image/png" in data:
                data["image/jpeg"] = jpeg(base64.b64decode(data.pop("image/png")))
    notebook.metadata = {"kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"}}
    return notebook


def plain(text: str) -> str:
    """What stays on a terminal: the end of each line that was written over, no progress, no blank line at the end."""
    lines = [line.rpartition("\r")[2].rstrip() for line in text.replace("\r\n", "\n").split("\n")]
    return "\n".join(line for line in lines if "%|" not in line).rstrip() + "\n"


def jpeg(png: bytes) -> str:
    """A PNG picture as JPEG, in base64."""
    file = io.BytesIO()
    with Image.open(io.BytesIO(png)) as picture:
        picture.convert("RGB").save(file, "JPEG", quality=QUALITY)
    return base64.b64encode(file.getvalue()).decode()


if __name__ == "__main__":
    sys.exit(main())
