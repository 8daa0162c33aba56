"""The definition file: XML that says what can be set, with a version that changes with it."""

from __future__ import annotations

from xml.etree import ElementTree as Xml

from hypothesis import given
from hypothesis import strategies as st

from dappled.daemon.camera_protocol.camera_definition import definition
from dappled.daemon.camera_protocol.camera_settings import Knob, code

ISO = Knob("CAM_ISO", "ISO", "100", ("Auto", "100", "200"))
APERTURE = Knob("CAM_APERTURE", "Aperture", "5.6")


def test_it_names_every_setting_with_its_choices() -> None:
    made = definition("Canon", "EOS <450D>", [ISO, APERTURE])
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
    base = definition("a", "b", [ISO]).version
    assert definition("a", "b", [Knob("CAM_ISO", "ISO", "200", ISO.choices)]).version == base
    assert definition("a", "b", [Knob("CAM_ISO", "ISO", "100", ("100", "200"))]).version != base
    assert definition("a", "c", [ISO]).version != base


@given(st.text(max_size=20))
def test_any_words_make_sound_xml_and_a_number_that_fits(words: str) -> None:
    printable = "".join(c for c in words if c.isprintable())
    Xml.fromstring(definition(printable, printable, [Knob("X", printable, printable, (printable,))]).xml)  # noqa: S314  # our own bytes
    assert 0 <= code(words) < 2**31
