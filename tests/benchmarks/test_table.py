"""The benchmarks' table: a limit can be missed, a figure can be missing, and both end 1."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dappled import __version__
from tests.benchmarks import FOLDER

sys.path.insert(0, str(FOLDER))

from limits import Limit, flat, read_limits  # once their folder is known
from table import TAIL, Row, added, main, measured, page, with_stored  # the same


def limit(at_most: float | None = None, at_least: float | None = None, noise: float = 0.1) -> Limit:
    return Limit("decode", "ratio", "a ratio", "SciPy", at_most, at_least, noise)


@pytest.mark.parametrize(
    ("asked", "value", "spread", "verdict"),
    [
        (limit(at_most=1.5), 1.49, 0.0, "ok"),
        (limit(at_most=1.5), 1.60, 0.0, "within noise"),
        (limit(at_most=1.5), 1.70, 0.0, "missed"),
        (limit(at_most=1.5), 1.70, 0.3, "within noise"),
        (limit(at_least=20.0), 17.0, 0.0, "missed"),
        (limit(at_least=20.0), 19.0, 0.0, "within noise"),
        (limit(at_least=0.8, at_most=1.2), 0.5, 0.0, "missed"),
        (limit(at_least=0.8, at_most=1.2), 1.0, 0.0, "ok"),
        (limit(at_most=0.0, noise=0.0), 1.0, 0.0, "missed"),
        (limit(), 7.0, 0.0, ""),
    ],
)
def test_a_limit_is_missed_beyond_its_noise(asked: Limit, value: float, spread: float, verdict: str) -> None:
    assert Row(asked, value, spread, None).verdict == verdict


@pytest.mark.parametrize(
    ("asked", "value", "words", "worse"),
    [
        (limit(at_most=1.5), 1.30, "+30%", True),
        (limit(at_most=1.5), 0.70, "-30%", False),
        (limit(at_least=0.1), 0.70, "-30%", True),
        (limit(at_most=1.5), 1.05, "same", False),
    ],
)
def test_a_change_counts_beyond_the_noise(asked: Limit, value: float, words: str, worse: bool) -> None:
    row = Row(asked, value, 0.0, 1.0)
    assert (row.changed, row.worse) == (words, worse)


def test_median_spread_and_what_no_run_gave() -> None:
    other = Limit("decode", "gone", "", "", None, None, 0.1)
    rows, missing = measured([limit(), other], {"decode": [{"ratio": 1.0}, {"ratio": 1.4}, {"ratio": 1.1}]}, {})
    assert [row.value for row in rows] == [1.1]
    assert [row.spread for row in rows] == pytest.approx([0.1])  # one outlier is not the spread
    assert missing == ["decode.gone"]


def test_nested_figures_by_their_path() -> None:
    assert dict(flat({"a": {"b": 1, "c": {"d": 2.5}}, "word": "x"})) == {"a.b": 1.0, "a.c.d": 2.5}


def test_every_limit_names_a_benchmark_and_every_ratio_its_anchor() -> None:
    for one in read_limits():
        assert (FOLDER / f"{one.benchmark}.py").is_file(), one.name
        assert one.anchor or "_over_" not in one.figure, one.name


def test_every_limit_can_be_missed() -> None:
    for one in read_limits():
        assert not one.asked or one.missed(1e12, 0.0) or one.missed(-1e12, 0.0), one.name


def test_the_page_marks_what_is_missed() -> None:
    on: dict[str, str | int | float] = {"model": "m", "cores": 2, "python": "3", "date": "d", "load_before": 0}
    text = page(
        [Row(limit(at_most=1.5), 1.7, 0.0, None)],
        on,
        1,
    )
    table = "| figure | compared with | value | asked |  |\n| --- | --- | --- | --- | --- |\n"
    assert table + "| a ratio | SciPy | 1.7 | at most 1.5 | **missed** |\n" in text


def test_figures_of_a_run_apart_are_added_and_named(tmp_path: Path) -> None:
    on: dict[str, str | int | float] = {"model": "m", "cores": 2, "python": "3", "date": "one day", "load_before": 0}
    later = on | {"date": "another day", "repeats": 3, "load_after": 0.2}
    first, second = limit(at_most=2.0), Limit("depth", "ratio", "depth", "OpenCV", 2.0, None, 0.1)
    path = tmp_path / "baseline.json"
    path.write_text(json.dumps({"machine": on, "figures": {"decode.ratio": 1.0, "decode.gone": 1.0}}), encoding="utf-8")
    now = [Row(second, 1.5, 0.05, None)]
    stored = added(path, [first, second], now, later)
    assert json.loads(path.read_text(encoding="utf-8")) == stored
    assert stored["figures"] == {"decode.ratio": 1.0, "depth.ratio": 1.5}
    assert stored["spreads"] == {"depth.ratio": 0.05}
    rows = with_stored(now, [first, second], stored)
    assert [(row.name, row.spread) for row in rows] == [("decode.ratio", 0.0), ("depth.ratio", 0.05)]
    assert with_stored([], [second], stored)[0].spread == 0.05
    before, after = page(rows, stored["machine"], 1, stored["apart"]).split("## depth")
    assert "one day" in before
    assert "another day" not in before
    assert (
        "Measured apart: m, 2 cores, Python 3, another day; load before the run 0, after it 0.2; median of 3." in after
    )


def test_the_page_is_of_this_release_or_of_the_one_before() -> None:
    """Figures of older code are no figures of this one: run `make bench`."""
    said = (FOLDER.parent / "docs" / "performance.md").read_text(encoding="utf-8")
    named = re.findall(r"^(?:Measured apart: )?dappled (\S+) at commit [0-9a-f]{8}\+?;", said, re.MULTILINE)
    released = re.findall(r"^## (\d+\.\S+)", (FOLDER.parent / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    recent = {__version__, *[one for one in released if one != __version__][:1]}
    assert named
    assert len(named) == said.count("load before the run")
    assert set(named) <= recent


def test_the_page_ends_with_what_the_next_one_would_say() -> None:
    said = (FOLDER.parent / "docs" / "performance.md").read_text(encoding="utf-8")
    begins, ends = TAIL.split("{cpu_s}")
    assert begins in said
    assert said.endswith(ends)


def test_the_page_says_what_no_pi_told() -> None:
    on: dict[str, str | int | float] = {"model": "m", "cores": 2, "python": "3", "date": "d", "load_before": 0}
    row = Row(Limit("onboard", "cpu_s_a_frame", "a frame", "", None, None, 0.2), 0.41, 0.0, None)
    assert "slices (0.41 CPU seconds)" in page([row], on, 1)
    assert "None was measured" in page([], on, 1)


def test_a_benchmark_that_fails_ends_1(tmp_path: Path) -> None:
    """The programs copied beside one that fails: as somebody would run it."""
    for name in ("limits.py", "table.py"):
        (tmp_path / name).write_text((FOLDER / name).read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "limits.toml").write_text(
        '[good.ratio]\ntext = "r"\nat_most = 2\nnoise = 0.1\n[bad.ratio]\ntext = "b"\nnoise = 0.1\n', encoding="utf-8"
    )
    (tmp_path / "good.py").write_text("print('{\"ratio\": 3}')", encoding="utf-8")
    (tmp_path / "bad.py").write_text("raise SystemExit('no camera was heard')", encoding="utf-8")
    out = tmp_path / "out.json"
    done = subprocess.run(
        [sys.executable, str(tmp_path / "table.py"), "--out", str(out)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "bad: no camera was heard" in done.stderr
    assert "bad.ratio was not measured" in done.stderr
    assert "good.ratio is 3, asked is at most 2" in done.stderr
    assert json.loads(out.read_text(encoding="utf-8"))["figures"] == {"good.ratio": 3.0}


def test_nothing_is_written_down_from_a_busy_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(os, "getloadavg", lambda: (99.0, 0.0, 0.0))
    monkeypatch.setattr(sys, "argv", ["table.py", "decode", "--add", "--baseline", str(tmp_path / "baseline.json")])
    with pytest.raises(SystemExit, match="2"):
        main()
    assert not (tmp_path / "baseline.json").exists()
