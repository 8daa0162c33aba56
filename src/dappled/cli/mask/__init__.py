"""`dappled mask make|table|diffraction|design|plan|kit`: design a printed mask, draw it, and test it on the bench."""

from __future__ import annotations

import argparse
from typing import Protocol

from dappled.cli.arguments import Actions
from dappled.cli.mask import design, diffraction, kit, make, plan, table


class Action(Protocol):
    """The module of one action."""

    HELP: str
    EXAMPLE: str

    def configure(self, parser: argparse.ArgumentParser, /) -> None: ...

    def run(self, arguments: argparse.Namespace, /) -> int: ...


_ACTIONS: dict[str, Action] = {
    "make": make,
    "table": table,
    "diffraction": diffraction,
    "design": design,
    "plan": plan,
    "kit": kit,
}


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "examples:\n" + "\n".join(f"  {one.EXAMPLE}" for one in _ACTIONS.values())
    actions = Actions.of(parser)
    for name, one in _ACTIONS.items():
        one.configure(actions.add(name, one.HELP, one.EXAMPLE))


def run(arguments: argparse.Namespace) -> int:
    return _ACTIONS[arguments.action].run(arguments)
