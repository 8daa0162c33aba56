"""`dappled trigger --distance` with a daemon. The photographs themselves: `test_virtual_truth`."""

from __future__ import annotations

from pathlib import Path

import pytest

from dappled.cli import main
from dappled.mocks.body.body import BodyOptions, SimulatedBody
from tests.system.flying import flying, settings_of
from tests.waiting import eventually


def test_settings_without_a_series_refuse_to_begin_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with SimulatedBody.start(BodyOptions(picture="pattern:50000:CR2")) as body:
        settings = settings_of(tmp_path, camera={"port": body.port}, mavlink={"url": "udpin:127.0.0.1:0"})
        with flying(settings) as daemon:
            daemon.until_ready()
            url = f"udpout:127.0.0.1:{daemon.service.parts.links.port(0)}"
            assert main(["trigger", "--url", url, "--distance", "settings"]) == 1
            assert "no photos: set trigger.distance_m or overlap" in capsys.readouterr().err
            assert main(["trigger", "--url", url, "--distance", "5"]) == 0
            eventually(lambda: "there is no position" in daemon.problems, "why none is taken is told")
            assert main(["trigger", "--url", url, "--distance", "off"]) == 0
            eventually(lambda: "there is no position" not in daemon.problems, "nothing is wanted any more")
            assert daemon.shots == []
    assert capsys.readouterr().out.splitlines() == [
        "a photograph every 5 m, until --distance off",
        "no more photographs",
    ]
