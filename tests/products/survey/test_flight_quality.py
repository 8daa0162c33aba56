"""The page of a flight's quality: what the commands say, on one page for a phone and one to print."""

from __future__ import annotations

import html
import re
from dataclasses import replace
from pathlib import Path

import pytest

from dappled import codec
from dappled.cli import main
from dappled.clock import SystemClock
from dappled.daemon.pipeline.flight_writer import LedgerWriter
from dappled.findings import FRAME, Code, finding
from dappled.flight import Result, recording
from tests.daemon.fakes import no_pose
from tests.flight.makers import deliver, request, tag
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


def _page(flight: Path, folder: Path) -> str:
    path = folder / "page.html"
    main(["flight", "report", str(flight), "--page", str(path)])
    return path.read_text()


def test_notes_are_no_doubts_and_names_are_no_html(tmp_path: Path) -> None:
    flight = recording.begin(tmp_path, SystemClock(), {})
    request(flight, 1)
    kept = deliver(flight, 1, b"x", "1.cr2")
    writer = LedgerWriter(flight, SystemClock())
    writer.tagged(replace(tag(kept), pose=no_pose()))
    why = codec.plain(finding(Code.FRAME_FOCUS_UNKNOWN, FRAME, why="<b>a lens of glass</b>"))
    verdict = {"state": "unknown", "reasons": [why], "facts": {}}
    writer.decoded(Result(1, "0" * 64, 1, 1, "fd", "predicted", 1.0, details={"verdict": verdict}))
    flight.close()
    page = _page(flight.folder.path, tmp_path)
    assert '<p class="verdict good">the counts agree; nothing is in doubt</p>' in page
    assert re.search("<h2>Notes</h2><ul><li>[^<]*focus unknown: &lt;b&gt;a lens of glass", page)
    assert "<h2>Doubts</h2>" not in page
    assert "no frame that can be placed on the ground" in page


def test_a_flight_without_a_shot_has_a_page(tmp_path: Path) -> None:
    flight = recording.begin(tmp_path, SystemClock(), {})
    flight.close()
    assert "no shot was taken; nothing is in doubt" in _page(flight.folder.path, tmp_path)


def test_the_page_to_print_is_a_pdf(recorded: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    main(["flight", "report", str(recorded), "--page", str(tmp_path / "quality.pdf")])
    page = (tmp_path / "quality.pdf").read_bytes()
    assert page.startswith(b"%PDF-")
    assert len(re.findall(rb"/Type /Page\b", page)) >= 2
