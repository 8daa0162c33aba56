"""Write KML for a virtual globe: a network link that is read every few seconds, and the latest frame on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree as ET

from dappled.decode.geometry.footprint import RectifiedFrame

NAMESPACE = "http://www.opengis.net/kml/2.2"
MEDIA_TYPE = "application/vnd.google-earth.kml+xml"


def network_link(href: str, *, every_s: float = 2.0) -> bytes:
    """A document that a globe opens once; the globe then reads `href` every `every_s`."""
    root, document = _document("dappled")
    link = _add(document, "NetworkLink")
    _add(link, "name", "dappled, the latest frame")
    target = _add(link, "Link")
    _add(target, "href", href)
    _add(target, "refreshMode", "onInterval")
    _add(target, "refreshInterval", f"{every_s:g}")
    return _bytes(root)


def latest(name: str, picture: str, frame: RectifiedFrame | None, track: Sequence[tuple[float, float, float]]) -> bytes:
    """The frame's picture as an overlay, and the track of (longitude, latitude, altitude above sea level)."""
    root, document = _document("dappled")
    if frame is not None:
        overlay = _add(document, "GroundOverlay")
        _add(overlay, "name", name)
        _add(_add(overlay, "Icon"), "href", picture)
        box = _add(overlay, "LatLonBox")
        for side in ("north", "south", "east", "west"):
            _add(box, side, f"{getattr(frame, side):.9f}")
    if len(track) > 1:
        mark = _add(document, "Placemark")
        _add(mark, "name", "track")
        line = _add(mark, "LineString")
        _add(line, "altitudeMode", "absolute")
        _add(line, "coordinates", " ".join(f"{lon:.8f},{lat:.8f},{alt:.2f}" for lon, lat, alt in track))
    return _bytes(root)


def _document(name: str) -> tuple[ET.Element, ET.Element]:
    root = ET.Element("kml", xmlns=NAMESPACE)
    document = _add(root, "Document")
    _add(document, "name", name)
    return root, document


def _add(parent: ET.Element, name: str, text: str | None = None) -> ET.Element:
    child = ET.SubElement(parent, name)
    child.text = text
    return child


def _bytes(root: ET.Element) -> bytes:
    text: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return text
