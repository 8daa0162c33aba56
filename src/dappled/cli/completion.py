"""`dappled completion`: print a completion script for bash, zsh or fish, made from the arguments of all verbs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from dappled.cli.command_line import options
from dappled.cli.table import VERBS
from dappled.cli.verb import Output, Report, Verb, argument

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


@dataclass(frozen=True, kw_only=True)
class PrintCompletion(Verb):
    """Print a completion script."""

    examples = (f"dappled completion bash > {_WHERE['bash']}",)
    notes = "where it goes:\n" + "\n".join(f"  {shell:5} {where}" for shell, where in _WHERE.items())

    shell: str = argument("SHELL", f"the shell: {', '.join(_WHERE)}", choices=tuple(_WHERE))

    def run(self, output: Output) -> Report:
        script = _fish(words()) if self.shell == "fish" else (_ZSH if self.shell == "zsh" else "") + _bash(words())
        return Report({"shell": self.shell, "script": script}, script.splitlines())


def words() -> dict[str, list[str]]:
    """What may come after each path of words: verbs, actions, options, and the choices of arguments."""
    found: dict[str, list[str]] = {
        "": [*dict.fromkeys(path.split()[0] for path in VERBS), "--help", "--version", "--debug"]
    }
    for path in VERBS:
        group, _, action = path.rpartition(" ")
        if group:
            found.setdefault(group, ["--help"]).append(action)
        found[path.replace(" ", "/")] = options(path)
    return found


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
    return "\n".join(lines)
