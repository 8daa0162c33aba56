"""Mutations stand where they did: a pattern that is not in the code any more breaks nothing, and shows nothing."""

from __future__ import annotations

import runpy

from tests.architecture.walk import ROOT, SOURCE


def test_what_each_mutation_breaks_is_there_once_and_so_are_its_tests() -> None:
    """Otherwise mend its pattern in tools/mutations.py."""
    all_of_them = runpy.run_path(str(ROOT / "tools" / "mutations.py"), run_name="mutations")["MUTATIONS"]
    gone = [one.name for one in all_of_them if (SOURCE / one.file).read_text("utf-8").count(one.old) != 1]
    assert gone == []
    assert [name for one in all_of_them for name in one.tests if not (ROOT / "tests" / name).exists()] == []
