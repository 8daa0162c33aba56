"""Findings as values, and the one table of their words."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import dappled
from dappled import codec, findings
from dappled.errors import DappledError
from dappled.findings import FRAME, Code, Fault, Finding, Level, Subject, finding, words

SOURCE = Path(dappled.__file__).parent


def test_each_code_has_words_and_is_found_somewhere() -> None:
    names = {
        name
        for path in SOURCE.rglob("*.py")
        if path.name != "findings.py"
        for name in re.findall(r"Code\.([A-Z_0-9]+)", path.read_text("utf-8"))
    }
    assert {one.name for one in Code} <= names, "a code that nothing finds"


def test_type_checkers_read_the_codes_of_the_table() -> None:
    """`tools/findings_page.py` writes them."""
    listed = re.findall(r'^    (\w+) = "(.*)"$', (SOURCE / "finding_codes.pyi").read_text("utf-8"), re.MULTILINE)
    assert listed == [(one.name, one.value) for one in Code]


def test_the_words_of_all_codes_stand_in_one_order() -> None:
    assert [one.value for one in words()] == [one.value for one in Code] == sorted(one.value for one in Code)


def test_a_finding_survives_json_and_is_equal_by_code_and_subject() -> None:
    one = finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", 4), rival=5)
    assert codec.read(Finding, codec.plain(one)) == one
    assert one.level is Level.CAUTION
    assert one.kind == finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", 4), rival=6).kind
    assert findings.first_of_each([one, finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", 4), rival=6)]) == [one]


def test_the_worst_comes_first_then_the_newest() -> None:
    card = finding(Code.CARD_CHANGED, Subject("flight"))
    old, new = (finding(Code.FRAME_RIVAL_SHOTS, Subject("frame", number), rival=9) for number in (1, 2))
    assert findings.in_order([old, card, new]) == [new, old, card]
    assert findings.worst([card, old]) is Level.CAUTION
    assert findings.worst([]) is Level.NOTE


def test_words_take_the_facts() -> None:
    one = finding(Code.FRAME_CLOCK_DISAGREES, Subject("frame", 4), off_s=-8.0)
    assert str(findings.text(one)) == "by the body's clock it was taken -8 s away from its shot"
    assert str(findings.told(one)) == f"frame 4: {findings.text(one)}: compare the picture with its neighbours"


def test_a_small_share_of_a_picture_is_not_told_as_none() -> None:
    assert str(findings.text(finding(Code.PICTURE_SOFT, Subject("picture"), share=0.0017))).startswith("0.17% of it")


def test_facts_from_a_damaged_file_are_shown_as_they_are() -> None:
    one = Finding(Code.CAMERA_ABSENT, Subject("camera"), {"reason": ""})
    assert str(findings.text(one)) == "the camera is absent"
    assert "None" in str(findings.text(Finding(Code.POSITION_JUMPED, Subject("vehicle"))))
    assert findings.of_json_text('{"code": "camera.absent"}') is None
    assert findings.of_json_text("the camera is absent") is None
    assert findings.of_json_text(findings.json_text(one)) == one


def test_a_number_that_no_format_takes_is_shown() -> None:
    assert findings.text(finding(Code.FRAME_CLIPPED, Subject("frame", 1), share=10**400))


def test_a_number_that_is_not_finite_is_unknown_and_the_finding_survives_the_ledger() -> None:
    one = finding(Code.FRAME_CLOCK_DISAGREES, Subject("frame", 4), off_s=float("nan")).with_facts(far_s=float("inf"))
    back = findings.of_json_text(findings.json_text(one))
    assert back is not None
    assert back.facts == {"off_s": None, "far_s": None}


def test_a_fact_may_be_an_error_or_a_finding_and_only_a_renderer_makes_words_of_it() -> None:
    lost = finding(Code.FILE_UNREADABLE, FRAME, name="a.cr2", why=FileNotFoundError(2, os.strerror(2), "flights/a.cr2"))
    assert lost.facts["why"] == Fault("FileNotFoundError", 2, "flights/a.cr2")
    assert str(findings.text(lost)) == "a.cr2 can't be read: No such file or directory"
    misfit = finding(Code.DECODE_MISFIT, FRAME, why=lost)
    assert str(findings.text(misfit)) == f"frames can't be decoded: {findings.text(lost)}"
    assert findings.of_json_text(findings.json_text(misfit)) == misfit
    assert codec.plain(misfit)["facts"]["why"]["facts"]["why"]["errno"] == 2


def test_an_error_tells_what_led_to_it_and_its_own_finding_where_it_has_one() -> None:
    try:
        try:
            raise PermissionError(13, "?", b"a.cr2")
        except OSError as error:
            raise DappledError("cannot read a.cr2") from error
    except DappledError as error:
        made = finding(Code.FRAME_UNDECODABLE, FRAME, why=error)
    assert made.facts["why"] == Fault("DappledError", 13, "a.cr2", "cannot read a.cr2")
    own = finding(Code.FRAME_CLIPPED, FRAME, share=0.1)
    assert finding(Code.FRAME_UNDECODABLE, FRAME, why=DappledError(own)).facts["why"] == own
    assert str(DappledError(own)) == str(findings.told(own, FRAME))
    refused = finding(Code.FILE_UNREADABLE, FRAME, name="a", why=OSError(22, "it is no plain file", "a"))
    assert str(findings.text(refused)) == "a can't be read: it is no plain file"
    damaged = finding(Code.FLIGHT_PART_DAMAGED, FRAME, part="the tags", why=ValueError("no such orders"))
    assert str(findings.text(damaged)).endswith("damaged: ValueError: no such orders")


def test_findings_that_lead_to_each_other_have_an_end() -> None:
    row = '{"code": "decode.misfit", "subject": {"kind": "a"}, "level": "note", "facts": {"why": '
    for deep in (2, 8, 9, 200, 3000):
        read = findings.of_json_text(row * deep + "1" + "}}" * deep)
        assert (read is None) == (deep > 9)
        assert read is None or findings.told(read)


def test_a_subject_that_is_no_name_is_refused() -> None:
    row = codec.plain(finding(Code.FRAME_CLIPPED, Subject("frame", 1), share=0.1))
    assert findings.of_json_text(json.dumps(row)) is not None
    row["subject"]["which"] = [1]
    assert findings.of_json_text(json.dumps(row)) is None


def test_no_code_can_read_what_is_rendered_for_people() -> None:
    said = findings.told(finding(Code.FRAME_CLIPPED, Subject("frame", 4), share=0.5))
    assert str(said) == f"{said}" != ""
    readers = ("split", "partition", "startswith", "find", "__contains__", "__iter__", "__getitem__", "__len__")
    assert not [name for name in readers if hasattr(said, name)]
    assert "__eq__" not in vars(type(said))  # mypy then refuses to compare it with a text
