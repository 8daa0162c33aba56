"""Build KML 2.2 (OGC 07-147r2) for virtual globes."""

from __future__ import annotations

from collections.abc import Mapping
from xml.etree import ElementTree as ET

MEDIA_TYPE = "application/vnd.google-earth.kml+xml"
_NAMESPACES = {"": "http://www.opengis.net/kml/2.2", "gx": "http://www.google.com/kml/ext/2.2"}


def node(tag: str, *inside: ET.Element | str) -> ET.Element:
    """An element that holds text or others; "gx:…" is one of Google's extension."""
    space, _, name = tag.rpartition(":")
    made = ET.Element(f"{{{_NAMESPACES[space]}}}{name}")
    made.text = next((one for one in inside if isinstance(one, str)), None)
    made.extend(one for one in inside if not isinstance(one, str))
    return made


def overlay(name: str, href: str, where: ET.Element, *more: ET.Element) -> ET.Element:
    """A picture on the ground; `more` stands behind its name."""
    return node("GroundOverlay", node("name", name), *more, node("Icon", node("href", href)), where)


def box(tag: str, bounds_deg: Mapping[str, float]) -> ET.Element:
    """The sides north, south, east and west, in the schema's order."""
    return node(tag, *(node(side, f"{bounds_deg[side]:.10f}") for side in ("north", "south", "east", "west")))


def page(*inside: ET.Element) -> bytes:
    """The file of a document that holds these."""
    for prefix, space in _NAMESPACES.items():
        ET.register_namespace(prefix, space)
    return bytes(ET.tostring(node("kml", node("Document", *inside)), encoding="utf-8", xml_declaration=True))
