"""The udev rule that ships: no tool here reads it, so its form is checked against udev(7)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

RULES = Path(__file__).parents[2] / "systemd" / "70-dappled-camera.rules"
_PART = re.compile(
    r'(ACTION|SUBSYSTEM|KERNEL|ENV\{\w+\}|ATTR\{[\w/]+\}|TEST|MODE|GROUP|TAG|GOTO|LABEL)(==|!=|\+=|=)"([^"]*)"'
)
_MATCH_ONLY = {"ACTION", "SUBSYSTEM", "KERNEL", "TEST"}


def parts(line: str) -> list[tuple[str, str, str]]:
    found = [_PART.fullmatch(part.strip()) for part in line.split(", ")]
    assert all(found), line
    return [(one[1], one[2], one[3]) for one in found if one]


@pytest.fixture(scope="module")
def rules() -> list[list[tuple[str, str, str]]]:
    lines = [line for line in RULES.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    return [parts(line) for line in lines]


def test_every_jump_has_a_later_label(rules: list[list[tuple[str, str, str]]]) -> None:
    labels = {value: at for at, rule in enumerate(rules) for key, _, value in rule if key == "LABEL"}
    jumps = [(at, value) for at, rule in enumerate(rules) for key, _, value in rule if key == "GOTO"]
    assert jumps
    assert all(labels[value] > at for at, value in jumps)


def test_keys_that_only_match_are_never_assigned(rules: list[list[tuple[str, str, str]]]) -> None:
    for rule in rules:
        assert all(operator in ("==", "!=") for key, operator, _ in rule if key in _MATCH_ONLY)


def test_it_comes_before_logind_gives_access_to_the_seat() -> None:
    assert int(RULES.name[:2]) < 73  # 73-seat-late.rules acts on the tag uaccess


def test_cameras_are_given_to_the_group(rules: list[list[tuple[str, str, str]]]) -> None:
    given = [rule for rule in rules if ("GROUP", "=", "plugdev") in rule]
    assert all(("MODE", "=", "0660") in rule for rule in given)
    matched = {(key, value) for rule in given for key, operator, value in rule if operator == "=="}
    assert all({"ATTR{idProduct}", "ENV{ID_USB_INTERFACES}"} & {key for key, *_ in rule} for rule in given), (
        "no maker's devices are given whole"
    )
    assert {("ATTR{idVendor}", "04a9"), ("ATTR{idVendor}", "04cb")} <= matched


def test_no_line_of_the_board_is_given_to_the_group(rules: list[list[tuple[str, str, str]]]) -> None:
    first = next(rule for rule in rules if ("SUBSYSTEM", "!=", "usb") in rule)
    assert ("GOTO", "=", "dappled_end") in first
    assert all(value == "usb" for rule in rules for key, _, value in rule if key == "SUBSYSTEM")
