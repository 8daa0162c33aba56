"""`dappled completion`: print a completion script for bash, zsh or fish, made from the parsers of all verbs."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from dappled.cli.command_line import parser
from dappled.cli.table import VERBS

Words = Mapping[str, list[str]]  # by the words before it ("", "mask", "mask make"): what may come next

_BASH = """\
_dappled() {{
  local at="" word i
  for ((i = 1; i < COMP_CWORD; i++)); do
    word="${{COMP_WORDS[i]}}"
    case " {branches} " in *" ${{at:+$at/}}$word "*) at="${{at:+$at/}}$word" ;; esac
  done
  local words
  case "$at" in
{cases}
  esac
  local now="${{COMP_WORDS[COMP_CWORD]}}" files=""
  case "$at" in ?*) case "$now" in -*) ;; *) files=yes ;; esac ;; esac
  local IFS=$'\n'
  COMPREPLY=($(compgen -W "${{words// /$'\n'}}" -- "$now") ${{files:+$(compgen -f -- "$now")}})
}}
complete -o filenames -F _dappled dappled
"""
_ZSH = "autoload -Uz compinit && compinit\nautoload -U +X bashcompinit && bashcompinit\n"
_WHERE = {
    "bash": "~/.local/share/bash-completion/completions/dappled",
    "zsh": "a file that ~/.zshrc sources",
    "fish": "~/.config/fish/completions/dappled.fish",
}


def configure(parser: argparse.ArgumentParser) -> None:
    lines = "\n".join(f"  {shell:5} {where}" for shell, where in _WHERE.items())
    parser.epilog = f"example: dappled completion bash > {_WHERE['bash']}\n\nwhere it goes:\n{lines}"
    parser.add_argument("shell", choices=tuple(_WHERE), help="the shell")


def run(arguments: argparse.Namespace) -> int:
    found: dict[str, list[str]] = {"": [*VERBS, "--help", "--version", "--debug"]}
    for verb in VERBS:
        found |= words(verb, below(parser(verb))[verb])
    print(
        _fish(found) if arguments.shell == "fish" else (_ZSH if arguments.shell == "zsh" else "") + _bash(found), end=""
    )
    return 0


def words(path: str, parser: argparse.ArgumentParser) -> dict[str, list[str]]:
    """What may come after `path` and after each action below it: actions, options, and the choices of arguments."""
    options = [name for action in parser._actions for name in action.option_strings if name.startswith("--")]
    choices = [
        str(choice)
        for action in parser._actions
        if action.choices and not isinstance(action, argparse._SubParsersAction)
        for choice in action.choices
    ]
    actions = below(parser)
    found = {path: [*actions, *options, *choices]}
    for name, one in actions.items():
        found |= words(f"{path}/{name}", one)
    return found


def below(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parsers of the actions of a parser, by name."""
    return {
        name: one
        for action in parser._actions
        if isinstance(action, argparse._SubParsersAction)
        for name, one in action.choices.items()
    }


def _bash(found: Words) -> str:
    branches = " ".join(path for path in found if path)
    cases = "\n".join(f'    "{path}") words="{" ".join(names)}" ;;' for path, names in found.items())
    return _BASH.format(branches=branches, cases=cases)


def _fish(found: Words) -> str:
    lines = []
    for path, names in found.items():
        steps = path.split("/") if path else []
        inside = [f"__fish_seen_subcommand_from {step}" for step in steps] or ["__fish_use_subcommand"]
        for name in names:
            kind = f"-l {name[2:]}" if name.startswith("--") else f"-a {name}"
            lines.append(f"complete -c dappled -n '{'; and '.join(inside)}' {kind}")
    return "\n".join(lines) + "\n"
