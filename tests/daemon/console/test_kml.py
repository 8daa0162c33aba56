"""KML as a virtual globe reads it."""

from __future__ import annotations

from xml.etree import ElementTree as ET

import numpy as np

from dappled.daemon.console import kml
from dappled.decode.geometry.footprint import RectifiedFrame
from tests import globe

NS = {"k": kml.NAMESPACE}


def parsed(document: bytes) -> ET.Element:
    globe.check(document)
    return ET.fromstring(document)  # noqa: S314  # our own


def test_a_link_asks_again_and_again() -> None:
    link = parsed(kml.network_link("http://h/kml/latest.kml?token=a&b")).find(".//k:NetworkLink/k:Link", NS)
    assert link is not None
    assert link.findtext("k:href", "", NS) == "http://h/kml/latest.kml?token=a&b"
    assert (link.findtext("k:refreshMode", "", NS), link.findtext("k:refreshInterval", "", NS)) == ("onInterval", "2")


def test_the_latest_frame_lies_in_its_box() -> None:
    frame = RectifiedFrame(np.zeros((2, 2, 4), dtype=np.uint8), 1.5, 1.25, 10.5, -10.25)
    root = parsed(kml.latest("frame 7", "http://h/kml/7.png", frame, [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)]))
    box = root.find(".//k:GroundOverlay/k:LatLonBox", NS)
    assert box is not None
    sides = [float(box.findtext(f"k:{side}", "", NS)) for side in ("north", "south", "east", "west")]
    assert sides == [1.5, 1.25, 10.5, -10.25]
    assert root.findtext(".//k:Icon/k:href", "", NS) == "http://h/kml/7.png"
    assert root.findtext(".//k:coordinates", "", NS).split() == [
        "1.00000000,2.00000000,3.00",
        "4.00000000,5.00000000,6.00",
    ]


def test_before_the_first_frame_there_is_an_empty_document() -> None:
    root = parsed(kml.latest("frame None", "", None, []))
    assert root.find("k:Document", NS) is not None
    assert root.find(".//k:GroundOverlay", NS) is None
