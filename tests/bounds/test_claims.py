"""What a file claims against what it can hold."""

from __future__ import annotations

import zlib
from pathlib import Path

import pytest

from dappled.bounds import claims
from dappled.bounds.claims import ClaimError

GB = 10**9


def test_a_small_claim_needs_no_proof() -> None:
    claims.check_size(claims.FREE_BYTES, 0, "array")


def test_a_large_claim_must_be_borne_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "free_memory", lambda: 100.0 * GB)
    claims.check_size(2 * GB, 2 * GB // claims.RATIO + 1, "array")
    with pytest.raises(ClaimError, match=r"its array would take 20 GB of memory, and the 412 bytes that are stored"):
        claims.check_size(20 * GB, 412, "array")


def test_no_claim_exceeds_the_memory_that_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "free_memory", lambda: 1.5 * GB)
    claims.check_size(GB, GB, "array")
    with pytest.raises(ClaimError, match=r"would take 2 GB of memory, and 1\.5 GB are free: .*more memory"):
        claims.check_size(2 * GB, 2 * GB, "array")


def test_the_control_groups_limit_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:   4000000 kB\n")
    (tmp_path / "cgroup").write_text("0::/system.slice/dappled.service\n")
    unit = tmp_path / "groups" / "system.slice" / "dappled.service"
    unit.mkdir(parents=True)
    for name, place in (("_MEMORY", "meminfo"), ("_GROUP", "cgroup"), ("_GROUPS", "groups")):
        monkeypatch.setattr(claims, name, tmp_path / place)
    assert claims.free_memory() == 4_096_000_000
    (unit / "memory.max").write_text("max\n")
    (unit.parent / "memory.max").write_text("1000000000\n")
    assert claims.free_memory() == GB
    (tmp_path / "meminfo").unlink()
    assert claims.free_memory() == float("inf")


@pytest.mark.parametrize("shape", [None, "12", 5, [-1], [True], [1.5], [2**63], [1] * 9, [[1]], ["1"], [None]], ids=str)
def test_a_shape_is_a_short_list_of_whole_numbers(shape: object) -> None:
    with pytest.raises(ClaimError, match="the shape of its array"):
        claims.count(shape, "array")


def test_values_are_counted() -> None:
    assert claims.count((3, 4, 0), "array") == 0
    assert claims.count([10**6, 10**6], "array") == 10**12


def test_deflated_bytes_are_measured_without_keeping_them() -> None:
    packed = zlib.compress(bytes(50_000_000))
    claims.check_inflated(packed, 50_000_000, "chunk")
    with pytest.raises(ClaimError, match="its chunk unpacks to more than the 50 MB that it claims"):
        claims.check_inflated(packed, 49_999_999, "chunk")
    claims.check_inflated(b"no zlib at all", 10, "chunk")
    claims.check_inflated(packed[:1000], 50_000_000, "chunk")


@pytest.mark.parametrize(
    ("size", "words"), [(0, "0 bytes"), (999, "999 bytes"), (1500, "1.5 kB"), (20 * GB, "20 GB"), (10**21, "1e+03 EB")]
)
def test_sizes_in_words(size: int, words: str) -> None:
    assert claims.in_words(size) == words
