"""Patches as a depth map tells them: their variance by hand, and where they are not likely."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dappled.decode.joint.patch_model import SIDE, USUAL_KINDS
from dappled.decode.joint.patches import Patches
from dappled.decode.joint.told_patches import ToldPatches, likely_told, write_variance

PATCHES = Patches((96, 120), SIDE)  # 9 by 11 patches
COUNT = len(PATCHES.corners)


def told(members: list[int], kinds: list[int], rest: list[float], gained: list[float]) -> ToldPatches:
    """Patches of one view."""
    return ToldPatches(
        np.array(members),
        np.zeros((len(members), 1, SIDE, SIDE), dtype=np.float32),
        np.array(kinds),
        np.array([rest]),
        np.array(gained),
    )


def test_a_variance_is_the_geometric_mean_of_how_far_patches_are_apart_and_the_median_of_the_model_s() -> None:
    parts = [
        told([4, 7], [USUAL_KINDS[0], USUAL_KINDS[2]], [1.0, 9.0], [0, 0]),
        told([2, 9], [USUAL_KINDS[2], USUAL_KINDS[2]], [4.0, 1e9], [0, 0]),
    ]
    likely = np.zeros(COUNT, dtype=bool)
    likely[[4, 7, 2]] = True  # the median of 1, 9 and 4 is 4
    variance, apart = np.full((1, COUNT), 7.0), np.full((1, COUNT), 100.0)
    apart[0, 7] = 25.0
    write_variance(variance, apart, parts, likely)
    assert variance[0, 9] == 7  # not as told
    assert set(variance[0, ~likely]) == {7.0}
    np.testing.assert_allclose(variance[0, 2] / variance[0, 7], 2.0)  # of one kind: the root of 100/25
    np.testing.assert_allclose(variance[0, 4] / np.sqrt(100.0 * 4.0), 1.8)
    write_variance(variance, 4 * apart, parts, likely)
    np.testing.assert_allclose(variance[0, 4] / np.sqrt(400.0 * 4.0), 1.8)


def test_where_nothing_was_told_variances_stay() -> None:
    variance = np.ones((1, COUNT))
    write_variance(variance, variance + 1, [], np.zeros(COUNT, dtype=bool))
    assert set(variance[0]) == {1.0}


def around(row: int, column: int, reach: int) -> NDArray[np.bool_]:
    rows, columns = np.divmod(np.arange(COUNT), PATCHES.grid[1])
    return np.asarray((np.abs(rows - row) <= reach) & (np.abs(columns - column) <= reach))


def test_one_improbable_patch_is_an_edge_and_many_shine_through_each_other() -> None:
    everyone = list(range(COUNT))
    for reach, lost in ((0, False), (2, True)):
        gained = np.where(around(4, 5, reach), -3600.0, 100.0)
        found = likely_told([told(everyone, [USUAL_KINDS[1]] * COUNT, [1.0] * COUNT, list(gained))], PATCHES)
        assert found[4 * PATCHES.grid[1] + 5] != lost
        assert found[0]


def test_what_was_not_told_is_not_likely_told_and_counts_for_nobody() -> None:
    found = likely_told([told([3, 4], [USUAL_KINDS[1]] * 2, [1.0, 1.0], [-1000.0, 0.0])], PATCHES)
    np.testing.assert_array_equal(np.flatnonzero(found), [3, 4])


def test_patches_in_the_band_are_those_with_hardly_any_detail_beyond_it() -> None:
    kinds = list(USUAL_KINDS)
    found = told(list(range(len(kinds))), kinds, [1.0] * len(kinds), [0.0] * len(kinds)).in_band
    np.testing.assert_array_equal(found, [True, True, *(False,) * (len(kinds) - 2)])
