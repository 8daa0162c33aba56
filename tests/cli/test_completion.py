"""Completion scripts: what the shell offers, asked of the shell itself."""

from __future__ import annotations

import shutil
import subprocess

import pytest

from dappled.cli import VERBS, main
from tests.needs import without

pytestmark = pytest.mark.slow  # it loads every verb
BASH = shutil.which("bash") or ""


def scripts(shell: str, capsys: pytest.CaptureFixture[str]) -> str:
    assert main(["completion", shell]) == 0
    return capsys.readouterr().out


def offered(script: str, *words: str) -> set[str]:
    """What bash offers for the last of these words."""
    array = " ".join(f"'{word}'" for word in ("dappled", *words))
    ask = f"COMP_WORDS=({array}); COMP_CWORD={len(words)}; _dappled; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    done = subprocess.run([BASH, "-c", f"{script}\n{ask}"], capture_output=True, text=True, timeout=60, check=True)
    return set(done.stdout.split())


def test_a_camera_s_profile_has_one_name_in_all_verbs(capsys: pytest.CaptureFixture[str]) -> None:
    made = scripts("fish", capsys).splitlines()
    assert not [line for line in made if line.endswith("-l body")]
    masked = {line.removesuffix("-l mask") for line in made if line.endswith(" -l mask")}
    assert len(masked) > 10
    assert masked <= {line.removesuffix("-l camera") for line in made if line.endswith(" -l camera")} | {
        "complete -c dappled -n '__fish_seen_subcommand_from mask; and __fish_seen_subcommand_from diffraction' "
    }


def test_bash_offers_verbs_actions_options_and_choices(capsys: pytest.CaptureFixture[str]) -> None:
    if not BASH:
        without("no bash on this machine")
    made = scripts("bash", capsys)
    assert {path.split()[0] for path in VERBS} <= offered(made, "")
    assert offered(made, "geo") == {"geotag", "georeference"}
    assert {"make", "table", "diffraction"} <= offered(made, "mask", "")
    assert "--tile" in offered(made, "mask", "make", "--") or "--output" in offered(made, "mask", "make", "--")
    assert offered(made, "decode", "/etc/pass") >= {"/etc/passwd"}  # a file, beside what else may come
    assert "--overwrite" in offered(made, "decode", "frame.dng", "--o")
    assert offered(made, "completion", "") >= {"bash", "zsh", "fish"}
    assert "--simulate" in offered(made, "--debug", "run", "--s")


def test_every_verb_is_in_each_script(capsys: pytest.CaptureFixture[str]) -> None:
    for shell in ("bash", "zsh", "fish"):
        made = scripts(shell, capsys)
        for path in VERBS:
            assert f'"{path.replace(" ", "/")}")' in made or f"-a {path.split()[-1]}" in made, (shell, path)
    assert made.count("\n") > 100
