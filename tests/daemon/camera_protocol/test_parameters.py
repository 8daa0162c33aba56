"""Settings by name: each change is answered, whatever comes in between; and the definition file describes them."""

from __future__ import annotations

import struct
from collections.abc import Callable
from xml.etree import ElementTree as Xml

from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.camera_protocol.parameters import (
    TYPE,
    WAIT_NS,
    Parameter,
    Parameters,
    ParameterServer,
    camera_definition,
    code,
)
from dappled.drivers.camera import Setting, SettingName
from dappled.drivers.mavlink import MavlinkMessage, mavlink


class Body:
    """A body that never takes a change. `meanwhile` happens once, the next time that its settings are looked at."""

    def __init__(self) -> None:
        self.meanwhile: Callable[[], object] | None = None

    def settings(self) -> tuple[Setting, ...]:
        now, self.meanwhile = self.meanwhile, None
        if now is not None:
            now()
        return (Setting("iso", "100", ("100", "200", "400")),)

    def change(self, name: SettingName, value: str) -> None:
        """Asked, and deaf."""


def wanted(value: str) -> MavlinkMessage:
    """A PARAM_EXT_SET as it is received."""
    data = struct.pack("<I", code(value)).ljust(128, b"\0")
    sent = mavlink.MAVLink_param_ext_set_message(1, 100, b"CAM_ISO", data, TYPE)
    return mavlink.MAVLink(None).decode(bytearray(sent.pack(mavlink.MAVLink(None))))


def results(replies: list[MavlinkMessage]) -> list[int]:
    return [message.param_result for message in replies]


def test_a_value_asked_for_while_another_one_runs_out_is_answered_too() -> None:
    body = Body()
    server = ParameterServer(Parameters(body))
    first = server.set(wanted("200"), 0, 0)
    assert results(list(first.messages)) == [mavlink.PARAM_ACK_IN_PROGRESS]
    body.meanwhile = lambda: server.set(wanted("400"), 1, WAIT_NS)
    assert server.settled(WAIT_NS) == []  # 200 has given way to 400, which is on its way
    ((link, reply),) = server.settled(2 * WAIT_NS)
    assert (link, results(list(reply.messages))) == (1, [mavlink.PARAM_ACK_FAILED])
    assert server.settled(3 * WAIT_NS) == []


def test_how_it_ended_is_told_once_though_two_threads_look() -> None:
    body = Body()
    server = ParameterServer(Parameters(body))
    server.set(wanted("200"), 0, 0)
    told: list[object] = []
    body.meanwhile = lambda: told.extend(server.settled(WAIT_NS))
    told.extend(server.settled(WAIT_NS))
    assert len(told) == 1


ISO = Parameter("CAM_ISO", "ISO", "100", ("Auto", "100", "200"))
APERTURE = Parameter("CAM_APERTURE", "Aperture", "5.6")


def test_it_names_every_setting_with_its_choices() -> None:
    made = camera_definition("Canon", "EOS <450D>", [ISO, APERTURE])
    root = Xml.fromstring(made.xml)  # noqa: S314  # our own bytes
    assert root.findtext("definition/model") == "EOS <450D>"
    assert root.find("definition").get("version") == str(made.version)  # type: ignore[union-attr]  # it is there
    iso, aperture = root.findall("parameters/parameter")
    assert [(one.get("name"), int(one.get("value", ""))) for one in iso.iter("option")] == [
        ("Auto", code("Auto")), ("100", 100), ("200", 200)
    ]  # fmt: skip
    assert (iso.get("readonly"), aperture.get("readonly")) == (None, "1")
    assert made.uri(100) == "mftp://[;comp=100]/camera.xml"


def test_the_version_follows_the_content_and_not_the_value_of_now() -> None:
    base = camera_definition("a", "b", [ISO]).version
    assert camera_definition("a", "b", [Parameter("CAM_ISO", "ISO", "200", ISO.choices)]).version == base
    assert camera_definition("a", "b", [Parameter("CAM_ISO", "ISO", "100", ("100", "200"))]).version != base
    assert camera_definition("a", "c", [ISO]).version != base


@given(st.text(max_size=20))
def test_any_words_make_sound_xml_and_a_number_that_fits(words: str) -> None:
    printable = "".join(c for c in words if c.isprintable())
    Xml.fromstring(camera_definition(printable, printable, [Parameter("X", printable, printable, (printable,))]).xml)  # noqa: S314  # our own bytes
    assert 0 <= code(words) < 2**31
