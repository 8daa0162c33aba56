"""Words that errors share."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled import errors


def test_the_service_s_environment_is_not_one_to_install_into(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.prefix", str(tmp_path))
    assert errors.install_extra("ground") == "install it with: pip install 'dappled[ground]'"
    (tmp_path / errors.SERVICE_MANIFEST).touch()
    assert "on the ground, in an environment of its own: pip install" in errors.install_extra("ground")
