"""Hooks of mkdocs: pages beside docs/ become pages of the site, the verbs write one of their own, and no page fetches
anything from a network."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
BESIDE = ("README.md", "ARCHITECTURE.md", "CHANGELOG.md", "CONTRIBUTING.md")

FETCHED = re.compile(
    r"""<(?:script|img|iframe|source)\b[^>]*\bsrc=["']?(?:https?:)?//[^>]*>|<link\b[^>]*\bhref=["']?(?:https?:)?//[^>]*>"""
)
EXAMPLE = re.compile(r"^(```\w+\n)(examples/\S+)\n(?=```)", re.MULTILINE)
IDLE = re.compile(r'<link\b[^>]*\brel="?(?:canonical|prev|next)\b')  # these name a page and fetch nothing


def on_files(files: Any, config: Any) -> Any:
    """Add the pages; README.md is the first page of the site."""
    for name in BESIDE:
        files.append(File.generated(config, name, content=at_top((ROOT / name).read_text(encoding="utf-8"))))
    verbs = subprocess.run(
        [ROOT / ".venv/bin/python", ROOT / "tools/command_line_page.py"], capture_output=True, text=True, check=True
    )
    files.append(File.generated(config, "command-line.md", content=verbs.stdout))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Point links that lead out of docs/ to the added pages. Links elsewhere stay, and end a strict build. A block of
    code that names a file of examples/ gets its text."""
    markdown = EXAMPLE.sub(lambda found: found[1] + (ROOT / found[2]).read_text(encoding="utf-8"), markdown)
    return re.sub(rf"\]\(\.\./({'|'.join(map(re.escape, BESIDE))})(#[^)]*)?\)", r"](\1\2)", markdown)


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """Raises PluginError where a page would fetch something from the network."""
    fetched = [found[0] for found in FETCHED.finditer(output) if not IDLE.match(found[0])]
    if fetched:
        raise PluginError(f"{page.file.src_uri} fetches from the network: {fetched[0]}")
    return output


def at_top(markdown: str) -> str:
    """A page beside docs/ with its links as seen from within docs/."""
    return re.sub(r"\[([^\]]+)\]\(Containerfile\)", r"\1", re.sub(r"\]\(docs/", "](", markdown))
