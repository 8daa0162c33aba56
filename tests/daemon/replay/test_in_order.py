"""Triggers and shots without numbers: what is named is right, and what time can't tell is in doubt."""

from __future__ import annotations

import itertools
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.replay.in_order import Pairing, paired_in_order

LATE_US = 2_600_000


def flown(
    lost: set[int],
    *,
    number: int = 30,
    interval_s: float = 1.0,
    uneven: float = 0.0,
    delay_s: float = 0.02,
    jitter_s: float = 0.01,
    known_us: float = 100_000,
    seed: int = 1,
) -> tuple[Pairing, dict[int, int]]:
    """The pairing of a flight whose triggers `lost` made no shot, and the true one."""
    rng = random.Random(seed)  # noqa: S311  a simulation
    steps = [interval_s * (1 + uneven * rng.uniform(-1, 1)) for _ in range(number)]
    triggers = [round(1e6 * (1e9 + at_s)) for at_s in itertools.accumulate(steps)]
    kept = [place for place in range(number) if place not in lost]
    arrived = [triggers[place] + round(1e6 * (delay_s + rng.uniform(0, jitter_s))) for place in kept]
    shots = list(itertools.accumulate(arrived, max))  # no link overtakes itself
    found = paired_in_order(triggers, shots, known_us=known_us, late_us=LATE_US)
    return found, {place: shot for shot, place in enumerate(kept)}


@pytest.mark.parametrize(("delay_s", "interval_s"), [(-0.6, 1.0), (0.02, 0.2), (0.6, 1.0), (1.3, 0.2)])
@pytest.mark.parametrize("lost", [set(), {4, 5}, {3, 20}])
def test_a_trigger_lost_between_others_is_named_whatever_the_delay(
    delay_s: float, interval_s: float, lost: set[int]
) -> None:
    """With a delay of 0.6 s at 1 s the nearest one was named, three in a row, and one that was taken was doubled."""
    found, true = flown(lost, interval_s=interval_s, delay_s=delay_s)
    assert found.pairs == true
    assert found.triggers == dict.fromkeys(lost, ())
    assert found.delay_us == pytest.approx(delay_s * 1e6, abs=15_000)
    assert not any(found.of.values()) or delay_s != 0.02


@pytest.mark.parametrize("lost", [0, 29])
@pytest.mark.parametrize(("delay_s", "known_us"), [(-0.6, 100_000), (0.6, 100_000), (0.02, 0)])
def test_a_lost_one_at_an_end_is_the_first_or_the_last_where_the_delay_is_not_known(
    lost: int, delay_s: float, known_us: float
) -> None:
    """Regular triggers: all shots may as well be those of the triggers one before."""
    found, _ = flown({lost}, delay_s=delay_s, known_us=known_us)
    (named, others), *more = found.triggers.items()
    assert not more
    assert {named, *others} == {0, 29}
    assert all(found.of.values())


@pytest.mark.parametrize("lost", [0, 29])
def test_over_a_good_link_an_end_is_certain(lost: int) -> None:
    assert flown({lost})[0].triggers == {lost: ()}


@pytest.mark.parametrize("lost", [0, 29])
def test_at_5_hz_an_end_is_never_certain(lost: int) -> None:
    found, _ = flown({lost}, interval_s=0.2)
    assert {*found.triggers, *itertools.chain(*found.triggers.values())} == {0, 29}


@given(st.integers(0, 29), st.floats(-1.0, 1.0), st.integers(0, 1000))
def test_uneven_triggers_are_certain_at_any_delay(lost: int, delay_s: float, seed: int) -> None:
    found, true = flown({lost}, uneven=0.4, delay_s=delay_s, seed=seed)
    assert (found.pairs, found.triggers) == (true, {lost: ()})


@pytest.mark.parametrize("flights", [25, pytest.param(100, marks=pytest.mark.slow)])
def test_where_requests_are_as_uneven_as_triggers_the_lost_one_is_in_doubt(flights: int) -> None:
    """0 to 0.5 s late at 0.4 s: few flights are certain, and right; most others name it."""
    certain = wrong = covered = 0
    for seed in range(flights):
        lost = random.Random(seed).randrange(5, 25)  # noqa: S311  a simulation
        found, _ = flown({lost}, interval_s=0.4, delay_s=0.0, jitter_s=0.5, seed=seed)
        named = {*found.triggers, *itertools.chain(*found.triggers.values())}
        certain += len(named) == 1
        wrong += len(named) == 1 and named != {lost}
        covered += lost in named
    assert certain < 0.4 * flights
    assert wrong <= 0.02 * flights
    assert covered >= 0.7 * flights


def test_a_request_that_is_late_shifts_no_others() -> None:
    triggers = [1_000_000 * place for place in range(20)]
    shots = [at + 20_000 for at in triggers]
    shots[7] += 700_000
    found = paired_in_order(triggers, shots, known_us=100_000, late_us=LATE_US)
    assert found.pairs == {place: place for place in range(20)}


def test_a_shot_too_many_is_left_over() -> None:
    triggers = [1_000_000 * place for place in range(20)]
    shots = sorted([*(at + 20_000 for at in triggers), 7_400_000])
    found = paired_in_order(triggers, shots, known_us=100_000, late_us=LATE_US)
    assert found.shots == {8: ()}
    assert (found.pairs[7], found.pairs[8], len(found.pairs)) == (7, 9, 20)


def test_two_shots_at_once_are_one_or_the_other() -> None:
    triggers = [1_000_000 * place for place in range(20)]
    shots = sorted([*(at + 20_000 for at in triggers), 7_030_000])
    found = paired_in_order(triggers, shots, known_us=100_000, late_us=LATE_US)
    (left, others), *more = found.shots.items()
    assert not more
    assert {left, *others} == {7, 8}


@pytest.mark.parametrize(("triggers", "shots"), [([], []), ([5], []), ([], [5]), ([0], [10**9]), ([0, 1], [10**9])])
def test_with_nothing_to_pair_all_is_left_over(triggers: list[int], shots: list[int]) -> None:
    found = paired_in_order(triggers, shots, known_us=100_000, late_us=LATE_US)
    assert (found.pairs, set(found.triggers), set(found.shots)) == (
        {},
        set(range(len(triggers))),
        set(range(len(shots))),
    )


@given(st.lists(st.integers(0, 8_000_000), min_size=1, max_size=5), st.lists(st.integers(0, 8_000_000), max_size=5))
def test_pairs_are_in_order_and_everything_is_paired_or_left_over(triggers: list[int], shots: list[int]) -> None:
    found = paired_in_order(sorted(triggers), sorted(shots), known_us=100_000, late_us=LATE_US)
    assert list(found.pairs.values()) == sorted(set(found.pairs.values()))
    assert list(found.pairs) == sorted(found.pairs)
    assert set(found.pairs) | set(found.triggers) == set(range(len(triggers)))
    assert set(found.pairs.values()) | set(found.shots) == set(range(len(shots)))
    assert not set(found.pairs) & set(found.triggers)
