"""What real autopilots do, line by line, and the tests in which the simulated ones do it.

The lines are those of a note on ArduCopter 4.7-dev in software in the loop, flown against dappled. Matrix: the cells of
`benchmarks/autopilots.py` with this fault or wiring, which `test_autopilot_matrix.py` flies.
"""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from tests.benchmarks import program

TESTS = Path(__file__).parents[2]
PROTOCOL, NAVIGATION = "daemon/camera_protocol/test_autopilots.py", "daemon/navigation/test_owned_triggers.py"
COMPONENT, MOCK = "daemon/camera_protocol/test_component.py", "mocks/autopilot/test_personality.py"
STEPS, FORWARDED = "daemon/navigation/test_clock_steps.py", "daemon/pipeline/test_forwarded.py"
BOOKS = "daemon/replay/test_three_books.py"
ROUTES = "daemon/camera_protocol/test_report_routes.py"
FACTS: dict[str, tuple[tuple[str, str], ...]] = {
    "CAMERA_FEEDBACK is sent for every camera at every trigger; a time of 0 is no time": (
        (PROTOCOL, "test_a_trigger_of_one_of_two_wired_cameras_is_one_shot_of_that_camera"),
        (NAVIGATION, "test_another_cameras_contact_and_a_time_of_zero_are_no_times"),
        ("matrix", "ArduPilot, CAM2 of two, servo, pin"),
    ),
    "A pin's time has 32 bits and wraps every 71.6 minutes": (
        (PROTOCOL, "test_a_pins_time_counts_as_now_after_it_has_wrapped"),
        (NAVIGATION, "test_each_shot_has_its_own_time"),
        ("matrix", "pin wraps"),
    ),
    "The pin listens once ArduPilot itself has triggered": (
        (MOCK, "test_a_pin_sleeps_until_the_autopilot_has_triggered_its_camera"),
        ("matrix", "reboots"),
    ),
    "The feedback that creates a shot comes before the shot, which owns its stamp": (
        (NAVIGATION, "test_each_shot_has_its_own_time"),
        (NAVIGATION, "test_a_shot_without_a_contact_has_no_other_shots_time"),
        ("matrix", "ArduPilot, servo, pin"),
    ),
    "An exposure that has happened can't be refused": (
        (PROTOCOL, "test_exposures_that_happened_are_never_refused_and_requests_to_fire_are_denied"),
    ),
    "Broadcasts are forwarded and executed: one request, two messages of two senders": (
        (PROTOCOL, "test_a_broadcast_through_the_component_is_one_shot_and_one_refusal"),
        (FORWARDED, "test_requests_and_shots_are_the_same_number"),
        (FORWARDED, "test_an_interval_that_the_autopilot_runs_too_is_one_interval"),
        (MOCK, "test_a_broadcast_is_executed_and_one_to_a_camera_is_not"),
        ("matrix", "stations broadcast"),
    ),
    "Indices and CAM entries count ArduPilot's own triggers: a gap is a lost trigger": (
        (PROTOCOL, "test_each_trigger_that_was_lost_on_the_link_is_named"),
        (BOOKS, "test_each_trigger_that_is_not_in_all_three_is_named"),
        ("matrix", "link down"),
        ("matrix", "one packet of ten lost"),
    ),
    "The simulator's clock stalls, jumps and runs fast": (
        (STEPS, "test_a_pose_next_to_a_step_is_in_doubt_and_those_around_it_are_right"),
        (STEPS, "test_a_clock_that_runs_fast_gives_no_confident_pose"),
        ("matrix", "clock steps"),
        ("matrix", "late files, clock steps"),
        ("matrix", "silence, clock steps"),
        ("matrix", "clock 2 % fast"),
    ),
    "ATTITUDE has an error of its own: without a stated sigma it is unknown, not 0": (
        ("daemon/navigation/test_pose_quality.py", "test_the_autopilots_own_attitude_accuracy_counts"),
        ("matrix", "none"),
    ),
    "285 is sent to a companion's port only on request": (
        (MOCK, "test_what_a_vehicle_has_is_sent_on_request_alone"),
        (PROTOCOL, "test_a_gimbals_attitude_is_requested_where_the_camera_hangs_on_it_until_it_comes"),
        ("daemon/health/test_record.py", "test_a_gimbal_that_is_not_heard_is_a_problem_where_the_camera_is_on_it"),
    ),
    "MAVSDK's list_photos through ArduPilot asks for image 0 without end": (
        (PROTOCOL, "test_a_list_of_photographs_that_always_asks_for_the_first_one_ends"),
    ),
    "An untargeted TIMESYNC is forwarded to the radio; a camera on two ports is heard twice": (
        (PROTOCOL, "test_a_request_for_the_time_is_for_the_autopilot_alone"),
        (ROUTES, "test_a_report_is_sent_on_one_port_where_both_lead_to_the_same_stations"),
        (ROUTES, "test_no_report_is_lost_and_none_comes_twice_without_need"),
        ("matrix", "two ports"),
    ),
    "ArduPilot arms without a camera: text and the heartbeat's state tell the pilot": (
        (COMPONENT, "test_heartbeats_time_requests_and_streams_come_in_time_and_none_while_faulted"),
        ("system/test_mavlink_flights.py", "test_a_pilot_is_told_of_a_camera_that_went_and_came_back"),
    ),
    "Peers of 2026: MAVProxy's camera module; QGroundControl's two map points a photograph": (
        ("system/test_mavlink_peers.py", "test_mavproxys_camera_module"),
        ("daemon/camera_protocol/test_autopilot_facts.py", "test_the_page_says_how_to_have_one_map_point"),
    ),
}

HOSTS = "daemon/health/test_host_checks.py"
JUMPS, SORTIES = "daemon/navigation/test_jumps.py", "daemon/camera_protocol/test_sorties.py"
FLOWN = ("daemon/navigation/test_flown_autopilot.py", "test_replayed_positions_are_true_or_in_doubt")
MISSED: dict[str, tuple[tuple[str, str], ...]] = {  # what flights with a real autopilot showed to be wrong
    "A request that the link held is late, in tag and books": (
        FLOWN,
        (STEPS, "test_a_request_that_a_link_held_is_known_as_late"),
        (BOOKS, "test_requests_that_a_link_has_held_are_late_unless_the_autopilot_fires_the_camera"),
    ),
    "Frames that EXIF places elsewhere than their log are in doubt": (
        ("daemon/replay/test_replay.py", "test_pictures_that_say_another_time_than_where_they_are_placed_are_in_doubt"),
    ),
    "The doubt of a jump outlives a step of the clock, and ends by evidence": (
        FLOWN,
        (JUMPS, "test_a_doubt_of_the_position_outlives_steps_of_the_clock_and_ends_when_it_is_back"),
        (JUMPS, "test_a_doubt_ends_a_minute_after_the_receiver_has_come_back_where_the_position_is"),
    ),
    "Right after a step there is a pose": ((STEPS, "test_right_after_the_answer_that_shows_a_step_there_is_a_pose"),),
    "A contact keeps its time between steps": ((STEPS, "test_contacts_between_steps_keep_their_times"),),
    "A repeated broadcast is one frame": ((COMPONENT, "test_a_request_that_says_that_it_repeats_is_no_second_shot"),),
    "Interval 0, count 0 is one photograph": ((COMPONENT, "test_a_request_with_zeros_alone_is_one_photograph"),),
    "Camera ids": ((COMPONENT, "test_a_command_for_another_camera_is_denied_and_not_done"),),
    "PX4's own report of a contact is a shot": (
        (PROTOCOL, "test_each_contact_that_px4_reports_is_one_shot_whether_a_trigger_has_told_of_it_or_not"),
    ),
    "PX4's counter that was set back": (
        (PROTOCOL, "test_triggers_that_are_lost_after_px4s_counter_was_set_back_are_named"),
    ),
    "A crash and restart of the autopilot": (
        (PROTOCOL, "test_an_autopilot_without_time_that_starts_again_begins_its_numbers_again"),
        (PROTOCOL, "test_a_contact_of_a_new_start_is_a_shot_before_anything_else_shows_it"),
        (BOOKS, "test_each_trigger_around_a_restart_is_in_the_book_of_its_power_up"),
        (SORTIES, "test_some_sorties_miss_nothing"),
    ),
    "Two ports of one autopilot count once": (
        (BOOKS, "test_what_two_ports_of_the_autopilot_have_brought_is_counted_once"),
        (ROUTES, "test_a_report_is_sent_on_one_port_where_both_lead_to_the_same_stations"),
    ),
    "A log without triggers": ((BOOKS, "test_a_log_without_a_trigger_is_in_doubt_and_says_what_to_set"),),
    "Which rate is missing": (
        (PROTOCOL, "test_telemetry_that_comes_too_seldom_is_named_with_its_rate_until_it_comes_as_requested"),
    ),
    "A clock that is not real time": ((STEPS, "test_a_clock_that_runs_fast_gives_no_confident_pose"),),
    "CAMn_COMPID": ((PROTOCOL, "test_a_component_that_is_not_this_one_in_ardupilots_parameters_is_told"),),
    "262 asked for each second": ((COMPONENT, "test_a_station_that_asks_each_second_is_answered_each_time"),),
    "Relays as triggers": ((HOSTS, "test_a_relay_that_is_switched_by_itself_is_no_shot_where_something_else_fires"),),
    "What is declared is obeyed: zoom, and no video": (
        (COMPONENT, "test_what_is_declared_is_obeyed_and_what_is_not_is_refused"),
        (COMPONENT, "test_a_continuous_zoom_goes_on_until_it_is_stopped_or_at_the_end"),
    ),
    "A zoom is answered by the settings": (
        (COMPONENT, "test_an_accepted_zoom_is_answered_with_the_settings_and_again_when_the_body_has_it"),
    ),
    "263: orientation, height above ground": (
        (COMPONENT, "test_a_photograph_is_told_with_the_cameras_orientation_and_its_height_above_the_ground"),
    ),
    "A test shot isn't counted": ((PROTOCOL, "test_a_test_shot_is_a_photograph_that_covers_no_lost_trigger"),),
    "The storage's id": ((COMPONENT, "test_the_disk_is_storage_1_and_there_is_no_other"),),
    "CAM_CAP_REPORT 0 where dappled fires": (
        (NAVIGATION, "test_px4s_own_report_of_a_photograph_has_the_time_of_the_contact_or_of_the_trigger"),
        (PROTOCOL, "test_a_report_of_px4s_own_trigger_is_that_photograph_and_stands_in_for_it"),
    ),
}

LINES = 14  # of the note


def test_each_line_is_here_once_with_tests_of_its_own() -> None:
    """A test may hold two lines; but no line has only what another one has."""
    assert len(FACTS) == LINES
    assert len({frozenset(tests) for tests in FACTS.values()}) == LINES
    for fact, tests in FACTS.items():
        assert len(set(tests)) == len(tests), fact
        assert {place for place, _ in tests} - {"matrix"}, f"{fact}: the matrix alone does not say what it holds"


@pytest.mark.parametrize("fact", MISSED)
def test_each_thing_that_was_missed_has_its_tests(fact: str) -> None:
    for place, name in MISSED[fact]:
        assert runs(TESTS / place, name), f"{place} has no test {name} that runs"


@pytest.mark.parametrize("fact", FACTS)
def test_each_fact_has_its_tests(fact: str) -> None:
    world = program("autopilot_cell")
    flown = {name for cell in program("autopilots").cells() for name in (cell.wiring, cell.fault)}
    for place, name in FACTS[fact]:
        if place == "matrix":
            assert name in flown
            assert name in (*world.WIRINGS, *world.FAULTS)
        else:
            assert runs(TESTS / place, name), f"{place} has no test {name} that runs"


@cache
def functions(path: Path) -> list[ast.FunctionDef]:
    return [node for node in ast.parse(path.read_text("utf-8")).body if isinstance(node, ast.FunctionDef)]


def runs(path: Path, name: str) -> bool:
    """Whether a file of tests has this one, neither skipped nor expected to fail."""
    for node in functions(path):
        if node.name == name:
            return not any(word in ast.unparse(mark) for mark in node.decorator_list for word in ("skip", "xfail"))
    return False


def test_a_test_that_is_missing_or_skipped_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "test_one.py"
    path.write_text("@pytest.mark.skip\ndef test_a(): ...\ndef test_b(): ...\n# def test_c(\n", "utf-8")
    assert [runs(path, f"test_{name}") for name in "abc"] == [False, True, False]


def test_the_page_says_how_to_have_one_map_point() -> None:
    """The option that keeps the camera's messages from the ground station, as bit and as value."""
    (paragraph,) = [
        text
        for text in (TESTS.parent / "docs" / "mavlink.md").read_text("utf-8").split("\n\n")
        if text.startswith("**Two map points for one photograph.**")
    ]
    found = re.search(r"bit (\d+) of `SERIALn_OPTIONS` \([^)]*, (\d+);", paragraph)
    assert found is not None
    assert int(found[2]) == 2 ** int(found[1])
    assert {"CAMERA_FEEDBACK", "CAMERA_IMAGE_CAPTURED"} <= set(re.findall(r"CAMERA_[A-Z_]+", paragraph))
