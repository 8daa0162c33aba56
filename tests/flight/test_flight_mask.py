"""What the frames of a flight tell together of their mask."""

from __future__ import annotations

from dappled.decode.mask_odds import SEEN_NATS
from dappled.findings import FRAME, Code, Finding, Level, finding, remedy
from dappled.flight.flight_mask import FlightMask, doubts_over


def test_the_odds_of_a_mask_add_up_over_a_flight() -> None:
    """A frame that can't show it is in doubt until others have shown it, and again when it has fallen out."""
    unseen, flight = finding(Code.MASK_UNSEEN, FRAME, nats=-3.0), FlightMask()

    def one(index: int, nats: float | None) -> tuple[Finding, ...]:
        flight.add(index, nats)
        return flight.relieved((unseen,) if nats is not None and nats < 0 else ())

    assert flight.told is None
    assert one(0, -3.0) == (unseen,)
    assert one(1, 120.0) == ()
    assert one(2, -3.0) == ()
    assert one(2, -3.0) == ()
    (told,) = flight.unseen
    assert (told.level, told.facts["seen"], told.facts["frames"], told.facts["unseen"]) == (Level.NOTE, 1, 3, 2)
    assert str(remedy(told)) == ""
    for index in range(3, 7):
        fallen = one(index, -3.4)
    assert fallen == (unseen,)
    (told,) = flight.unseen
    assert (told.level, told.facts["frames"]) == (Level.CAUTION, 7)
    assert f"more than {SEEN_NATS} are asked" in str(remedy(told))
    assert one(7, None) == ()
    assert flight.unseen == (told,)


def test_a_mask_that_every_frame_shows_is_told_only_where_it_is_asked_for() -> None:
    flight = FlightMask()
    flight.add(0, 20.0)
    assert flight.unseen == ()
    assert flight.told is not None
    assert flight.told.level == Level.NOTE


def test_a_flight_s_doubts_are_those_of_its_frames_that_others_don_t_relieve() -> None:
    unseen, clipped = finding(Code.MASK_UNSEEN, FRAME, nats=-3.0), finding(Code.FRAME_CLIPPED, FRAME, share=0.02)
    frames = [("0", 20.0, ()), ("1", -3.0, (unseen, clipped)), ("2", None, (clipped,))]
    found = doubts_over(frames)
    assert [(one.code, str(one.subject), one.level) for one in found] == [
        (Code.FRAME_CLIPPED, "frame 1", Level.CAUTION),
        (Code.MASK_OVER_FLIGHT, "mask", Level.NOTE),
    ]
    assert [one.level for one in doubts_over(frames[1:]) if one.code is Code.MASK_OVER_FLIGHT] == [Level.CAUTION]
    assert Code.MASK_UNSEEN in [one.code for one in doubts_over(frames[1:])]
