"""What a file or folder that a call names must be. Each says what is wrong with another one, "" of a right one."""

from __future__ import annotations

from pathlib import Path

from dappled.cli.table import words_only

if not words_only:
    from dappled.flight import layout


def file(path: Path) -> str:
    """A file."""
    return f"{path} is a folder; name a file" if path.is_dir() else ""


def folder(path: Path) -> str:
    """A folder."""
    return "" if path.is_dir() else f"{path} is no folder; name one"


def flight(path: Path) -> str:
    """A recorded flight."""
    return layout.not_a_flight(path)


def opened(path: Path) -> str:
    """A flight, a decoded light field, a folder of views, or a raw frame."""
    from dappled.products import opened as products  # noqa: PLC0415  # as below

    return products.not_opened(path)


def light_field(path: Path) -> str:
    """A decoded light field, or a folder of views."""
    from dappled.products import opened  # noqa: PLC0415  # SciPy takes a second; verbs that read one load it anyway

    return opened.not_a_light_field(path)
