"""What a subscriber asks for again: no seq is forgotten, none is asked for twice."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.stream.subscriber import AT_ONCE, MOST_MISSING, Gaps
from dappled.daemon.stream.wire import Message


def slices(seq: int, flight: str = "f") -> Message:
    return Message("slices", {"flight": flight, "seq": seq})


def end(sent: int) -> Message:
    return Message("end", {"flight": "f", "sent": {"slices": sent}})


@given(st.integers(0, 40).flatmap(lambda n: st.tuples(st.just(n), st.sets(st.integers(0, max(n - 1, 0))))))
def test_whatever_is_lost_is_asked_for_once_and_had(flight: tuple[int, set[int]]) -> None:
    sent, heard = flight
    heard = {seq for seq in heard if seq < sent}
    gaps = Gaps(can_ask=True, from_start=True)
    for seq in sorted(heard):
        gaps.received(slices(seq))
    gaps.received(end(sent))
    asked: list[int] = []
    while questions := gaps.questions(0.0):
        assert len(questions) <= AT_ONCE
        for question in questions:
            asked.append(question["seq"])
            gaps.answered(Message("slices", {"asked": question}))
    assert sorted(asked) == sorted(set(range(sent)) - heard)
    assert (gaps.gaps, gaps.recovered, gaps.lost, gaps.waiting_for) == (len(asked), len(asked), 0, 0)


def test_without_anybody_to_ask_it_is_lost() -> None:
    gaps = Gaps(can_ask=False)
    gaps.received(slices(3))
    gaps.received(slices(6))
    assert (gaps.gaps, gaps.lost, gaps.questions(0.0)) == (2, 2, [])


def test_an_answer_that_never_comes_is_given_up() -> None:
    gaps = Gaps(can_ask=True, answer_timeout_s=10)
    gaps.received(slices(0))
    gaps.received(slices(2))
    assert [question["seq"] for question in gaps.questions(0.0)] == [1]
    assert gaps.questions(9.0) == []
    assert gaps.lost == 0
    gaps.questions(11.0)
    assert (gaps.lost, gaps.waiting_for) == (1, 0)


def test_an_error_is_a_loss_and_a_stranger_s_answer_is_nothing() -> None:
    gaps = Gaps(can_ask=True)
    gaps.received(slices(0))
    gaps.received(slices(2))
    (question,) = gaps.questions(0.0)
    gaps.answered(Message("slices", {"asked": {"get": "slices", "frame": 7}}))
    gaps.answered(Message("slices", {"asked": None}))
    assert gaps.waiting_for == 1
    gaps.answered(Message("error", {"asked": question}))
    assert (gaps.recovered, gaps.lost) == (0, 1)


def test_flights_are_counted_apart() -> None:
    gaps = Gaps(can_ask=True)
    gaps.received(slices(7, "one"))
    gaps.received(slices(0, "two"))
    gaps.received(slices(1, "two"))
    assert gaps.gaps == 0


def test_a_header_that_claims_the_impossible_costs_no_memory() -> None:
    gaps = Gaps(can_ask=True)
    gaps.received(slices(0))
    gaps.received(slices(10**12))
    assert gaps.gaps == 10**12 - 1
    assert gaps.waiting_for == MOST_MISSING
    assert gaps.gaps == gaps.lost + gaps.waiting_for
    assert gaps.questions(0.0)[0]["seq"] == 10**12 - MOST_MISSING
    gaps.received(slices(10**12 + 3))
    assert gaps.waiting_for == MOST_MISSING + AT_ONCE - 2  # four were asked for, and two more are missing
    assert gaps.gaps == gaps.lost + gaps.waiting_for


def test_what_the_sender_dropped_is_counted_to_its_last() -> None:
    """The last ones stand in no slices' header, only in the `end`; what was dropped before one came is another's."""

    def dropped(topic: str, header: dict[str, object]) -> Message:
        return Message(topic, {"flight": "f", **header})

    early, late = Gaps(can_ask=True, from_start=True), Gaps(can_ask=True)
    for gaps in (early, late):
        gaps.received(dropped("slices", {"seq": 0, "dropped": 2}))
        gaps.received(dropped("slices", {"seq": 1, "dropped": 3}))
        gaps.received(dropped("end", {"sent": {"slices": 2}, "unsent": {"slices": 7, "preview": 20}}))
    assert (early.unsent, late.unsent) == (7, 5)
    assert early.gaps == late.gaps == 0


def test_an_end_without_a_count_is_no_gap() -> None:
    gaps = Gaps(can_ask=True)
    gaps.received(slices(0))
    ends: list[object] = [None, [], {"slices": "many"}, {"slices": None}]
    for sent in ends:
        gaps.received(Message("end", {"flight": "f", "sent": sent}))
    assert gaps.gaps == 0
