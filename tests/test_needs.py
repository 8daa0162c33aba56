"""A skip for want of a program is a failure in CI."""

from __future__ import annotations

import pytest

from tests.needs import without


@pytest.mark.parametrize(("ci", "outcome"), [("1", pytest.fail.Exception), ("", pytest.skip.Exception)])
def test_ci_does_not_go_without(ci: str, outcome: type[BaseException], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CI", ci)
    with pytest.raises(outcome, match="not run: no browser"):
        without("no browser: apt install chromium")
