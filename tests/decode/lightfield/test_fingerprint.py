"""Fingerprints: rounding leaves them close, a change of content does not, and they are the same on every machine."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from dappled.decode.lightfield.light_field import difference, fingerprint


@pytest.fixture(scope="module")
def slices() -> NDArray[np.complex64]:
    rng = np.random.default_rng(1)
    made = rng.normal(size=(5, 130, 170)) + 1j * rng.normal(size=(5, 130, 170))
    made[1:] *= 0.02
    return made.astype(np.complex64)


def compared(a: NDArray[np.complex64], b: NDArray[np.complex64]) -> float:
    one, other = fingerprint(a), fingerprint(b)
    assert one is not None
    assert other is not None
    return difference(one, other)


def test_the_same_array_has_the_same_numbers_everywhere() -> None:
    found = fingerprint(np.arange(1000, dtype=np.float32))
    assert found is not None
    assert (found["count"], found["largest"]) == (1000, 999.0)
    # signs by splitmix64, by hand in Python's integers
    mask = (1 << 64) - 1

    def sign(at: int) -> int:
        z = at * 0x9E3779B97F4A7C15 & mask
        z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 & mask
        z = (z ^ (z >> 27)) * 0x94D049BB133111EB & mask
        return 1 - 2 * ((z ^ (z >> 31)) >> 63)

    for column in (0, 17, 63):
        block = sign((1 << 32) + column + 1)
        assert found["sums"][column] == block * sum(sign(at + 1) * at for at in range(column, 1000, 64))


def test_rounding_is_close_and_says_its_size(slices: NDArray[np.complex64]) -> None:
    assert compared(slices, slices) == 0.0
    rng = np.random.default_rng(2)
    largest = float(max(np.abs(slices.real).max(), np.abs(slices.imag).max()))
    for share in (1e-7, 1e-4):
        noise = rng.normal(size=slices.shape) + 1j * rng.normal(size=slices.shape)
        found = compared(slices, (slices + share * largest * noise).astype(np.complex64))
        assert share < found < 5 * share  # the largest of 64 normal deviates


def test_a_change_of_content_is_far(slices: NDArray[np.complex64]) -> None:
    one = slices.copy()
    one[0, 60, 80] += 0.1
    assert compared(slices, one) > 1e-4
    assert compared(slices, np.roll(slices, 1, axis=2)) > 1e-2
    assert compared(slices, slices[[0, 2, 1, 3, 4]]) > 1e-3
    assert compared(slices, slices.conj()) > 1e-2
    assert compared(slices, slices[:, :-1]) == math.inf


def test_what_can_t_be_compared_is_infinitely_far(slices: NDArray[np.complex64]) -> None:
    holed = slices.copy()
    holed[0, 0, 0] = np.nan
    assert fingerprint(holed) is None
    whole = fingerprint(slices)
    assert whole is not None
    for damaged in ({}, {**whole, "sums": whole["sums"][:3]}, {**whole, "largest": 0.0}, {**whole, "sums": "x"}):
        assert difference(damaged, {**whole, "sums": [one + 1 for one in whole["sums"]]}) == math.inf
