"""The page of a flight's quality: what the commands say, on one page for a phone and one to print."""

from __future__ import annotations

import html
import re
from pathlib import Path

import pytest

from dappled.cli import main
from tests.products.maps.test_coverage import ALONG_M, recorded

__all__ = ["recorded"]  # a fixture


def test_a_page_tells_counts_ground_overlap_blur_poses_and_doubts(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "quality.html"
    main(["flight", "report", str(recorded), "--page", str(page)])
    assert str(page) in capsys.readouterr().out
    text = html.unescape(page.read_text())
    said = dict(re.findall(r"<tr><td>([^<]*)</td><td>([^<]*)</td></tr>", text))
    assert said["requests"].startswith("16, of them 0 refused")
    assert said["shots in the ledger"].startswith("16: 16 safe")
    cm = 100 * ALONG_M / 2856
    assert float(said["ground of a sensor's pixel"].split()[0]) == pytest.approx(cm, rel=0.05)
    assert 0 <= float(said["overlap with the next frame"].split()[0]) <= 100
    assert said["judged bad"] == "1"
    assert said["motion blur"] == "unknown"
    assert re.search(r"<li>.*it may be of shot 2 as well", text)
    assert 'name="viewport"' in text
    assert "http" not in text.replace("http-equiv", "")
    assert text.count("data:image/png;base64,") == 1
    assert main(["flight", "report", str(recorded), "--page", str(page)]) == 1
    assert "exists already" in capsys.readouterr().err
    assert main(["flight", "report", str(recorded), "--page", "quality.doc"]) == 2


def test_the_page_to_print_is_a_pdf(recorded: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    main(["flight", "report", str(recorded), "--page", str(tmp_path / "quality.pdf")])
    page = (tmp_path / "quality.pdf").read_bytes()
    assert page.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type /Page\b", page)) >= 2
