"""The camera definition file: which settings there are, in XML, as QGroundControl and MAVSDK read it. Pure."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from xml.sax.saxutils import escape, quoteattr

from dappled.daemon.camera_protocol.camera_settings import Knob, code

PATH = "camera.xml"


@dataclass(frozen=True, slots=True)
class Definition:
    """The file's bytes, and its version: ground stations cache it by vendor, model and version, so the version
    changes with the content (1 to 65535, made from it: the same content has the same version after a restart)."""

    version: int
    xml: bytes

    def uri(self, component_id: int) -> str:
        """Where it is fetched: over MAVLink FTP, from our component."""
        return f"mftp://[;comp={component_id}]/{PATH}"


def definition(vendor: str, model: str, knobs: Iterable[Knob]) -> Definition:
    """The definition of a camera with these settings."""
    parameters = "".join(_parameter(knob) for knob in knobs)
    version = zlib.crc32((vendor + "\0" + model + "\0" + parameters).encode()) % 65535 + 1
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n<mavlinkcamera>\n'
        f'  <definition version="{version}">\n'
        f"    <model>{escape(model)}</model>\n    <vendor>{escape(vendor)}</vendor>\n  </definition>\n"
        f"  <parameters>\n{parameters}  </parameters>\n</mavlinkcamera>\n"
    )
    return Definition(version, text.encode())


def _parameter(knob: Knob) -> str:
    """Choices in the body's order; a setting that can only be read has its value of now as the only one."""
    choices = knob.choices or (knob.value,)
    readonly = "" if knob.choices else ' readonly="1"'
    options = "".join(f'        <option name={quoteattr(one)} value="{code(one)}"/>\n' for one in choices)
    return (
        f'    <parameter name="{knob.name}" type="uint32" default="{code(choices[0])}"{readonly}>\n'
        f"      <description>{escape(knob.title)}</description>\n"
        f"      <options>\n{options}      </options>\n    </parameter>\n"
    )
