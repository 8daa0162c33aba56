"""`dappled mask make|table|diffraction|design|plan`: the printed mask, from altitude to film and back to the bench."""

from __future__ import annotations

import argparse
from typing import Protocol

from dappled.cli import mask_design, mask_diffraction, mask_make, mask_plan, mask_table
from dappled.cli.actions import Actions


class Action(Protocol):
    """A module of one action."""

    HELP: str
    EXAMPLE: str

    def configure(self, parser: argparse.ArgumentParser, /) -> None: ...

    def run(self, arguments: argparse.Namespace, /) -> int: ...


_ACTIONS: dict[str, Action] = {
    "make": mask_make,
    "table": mask_table,
    "diffraction": mask_diffraction,
    "design": mask_design,
    "plan": mask_plan,
}


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "examples:\n" + "\n".join(f"  {one.EXAMPLE}" for one in _ACTIONS.values())
    actions = Actions.of(parser)
    for name, one in _ACTIONS.items():
        one.configure(actions.add(name, one.HELP, one.EXAMPLE))


def run(arguments: argparse.Namespace) -> int:
    return _ACTIONS[arguments.action].run(arguments)
