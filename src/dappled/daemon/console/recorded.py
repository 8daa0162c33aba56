"""What the page shows of a recorded flight or a light field: tags, verdicts, and slices decoded when asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from dappled.daemon.console.pictures import FullSizePicture
from dappled.daemon.stream import wire
from dappled.daemon.stream.answers import SlicesDecoder
from dappled.daemon.stream.wire import Message
from dappled.decode.lightfield import LightField
from dappled.drivers.raw import developing
from dappled.drivers.raw.picture_maker import PictureMaker
from dappled.errors import DappledError
from dappled.findings import FRAME, told
from dappled.flight import FlightFolder, Tag
from dappled.flight.flight_report import FlightContents

_NO_POSE = (
    "utc_ns", "utc_sigma_ns", "latitude_deg", "longitude_deg", "altitude_msl_m", "height_above_home_m",
    "velocity_ned_m_s", "attitude", "roll_deg", "pitch_deg", "yaw_deg", "position_sigma_m", "attitude_sigma_deg",
    "age_ms",
)  # fmt: skip
_NO_MASK = "this flight was recorded without a mask: name one with --mask"


@dataclass(frozen=True, slots=True)
class ShownFrame:
    """The header of a frame's `frame` message, and its verdict in flight, if it was judged."""

    header: Mapping[str, Any]
    verdict: Mapping[str, Any] | None = None


class FrameSource(Protocol):
    """Recorded frames in the words of the stream."""

    @property
    def start(self) -> Mapping[str, Any]:
        """The header of the `start` message: flight, camera, mask."""

    @property
    def shots(self) -> Mapping[str, int]:
        """How many shots were wished for, and how many became safe frames."""

    def frames(self) -> Sequence[ShownFrame]:
        """All frames that have a tag, in order."""

    def slices(self, index: int) -> Message:
        """A frame's `slices` message. Takes as long as decoding. Raises DappledError."""

    def light_field(self, index: int) -> LightField | None:
        """The frame's light field where it was decoded before; None where views are made of its slices."""

    def full_size(self, index: int) -> FullSizePicture:
        """A frame's picture at the sensor's own resolution. Takes seconds; for one thread. Raises DappledError."""


class FlightFrames:
    """The frames of a recorded flight, decoded again by `decoder` and with full-size pictures by `maker` (None: the
    flight has no mask)."""

    def __init__(
        self,
        folder: FlightFolder,
        contents: FlightContents,
        decoder: SlicesDecoder | None,
        maker: PictureMaker | None = None,
    ) -> None:
        self._folder, self._contents, self._decoder, self._maker = folder, contents, decoder, maker
        self._last: tuple[int, FullSizePicture] | None = None
        self._lines = {line.frame.index: line for line in contents.lines if line.frame is not None}

    @property
    def start(self) -> Mapping[str, Any]:
        tags = [line.tag for line in self._lines.values() if line.tag is not None]
        camera, mask = (tags[0].camera, tags[0].mask) if tags else ("", "")
        return {"flight": self._contents.name, "camera": camera, "mask": mask}

    @property
    def shots(self) -> Mapping[str, int]:
        return {"wished": len(self._contents.lines), "safe": len(self._lines)}

    def frames(self) -> Sequence[ShownFrame]:
        shown = []
        for line in self._lines.values():
            if line.tag is not None and line.frame is not None:
                judged = None if line.result is None else line.result.verdict
                reasons = [] if judged is None else [str(told(one, FRAME)) for one in judged.reasons]
                verdict = None if judged is None else {"state": judged.state, "reasons": reasons}
                shown.append(ShownFrame(self._named(wire.frame_header(line.tag, line.frame, None)), verdict))
        return shown

    def slices(self, index: int) -> Message:
        """A frame's `slices` message."""
        path, tag = self._file(index)
        if self._decoder is None:
            raise DappledError(_NO_MASK)
        decoded = self._decoder.decode(path, tag.focal_length_mm, tag.f_number, index=index)
        return Message("slices", self._named(wire.slices_header(tag, decoded)), decoded.body)

    def full_size(self, index: int) -> FullSizePicture:
        """A frame's picture at the sensor's own resolution; the last one is kept."""
        if self._last is None or self._last[0] != index:
            path, tag = self._file(index)
            if self._maker is None:
                raise DappledError(_NO_MASK)
            made = self._maker.picture(path, focal_length_mm=tag.focal_length_mm, f_number=tag.f_number)
            self._last = index, FullSizePicture(developing.jpeg(made), made.doubts)
        return self._last[1]

    def _file(self, index: int) -> tuple[str, Tag]:
        line = self._lines.get(index)
        if line is None or line.frame is None or line.tag is None:
            raise DappledError(f"there is no frame {index} in this flight")
        return str(self._folder.file(line.frame.name)), line.tag

    def light_field(self, _index: int) -> LightField | None:
        return None

    def _named(self, header: Mapping[str, Any]) -> dict[str, Any]:
        return {**header, "flight": self._contents.name}


class LightFieldFrames:
    """One decoded light field as the only frame, number 0."""

    def __init__(self, name: str, size: int, field: LightField) -> None:
        """`size` is the file's, in bytes."""
        self._name, self._size, self._field = name, size, field

    @property
    def start(self) -> Mapping[str, Any]:
        return {"flight": self._name, "camera": self._said("camera") or "", "mask": self._said("mask") or ""}

    @property
    def shots(self) -> Mapping[str, int]:
        return {"wished": 1, "safe": 1}

    def frames(self) -> Sequence[ShownFrame]:
        facts = {"utc_sigma_ns": None, "time_source": "", "exposure_s": None, "iso": None}
        return [ShownFrame({**self._facts(), **facts, "name": self._name, "size": self._size})]

    def slices(self, index: int) -> Message:
        """A frame's `slices` message."""
        if index != 0:
            raise DappledError(f"there is no frame {index} in {self._name}")
        slices, carriers = self._field.slices, self._field.carriers
        if not len(slices):  # it came as views: their mean is what the carrier (0, 0) holds
            mean = self._field.views.reshape(-1, *self._field.views.shape[2:]).mean(axis=0)
            slices = (mean.mean(axis=-1) if mean.ndim == 3 else mean)[None].astype(np.complex64)
            carriers = np.zeros((1, 4))
        slices = np.ascontiguousarray(slices)
        height, width = slices.shape[1:]
        header = {
            **self._facts(),
            "carriers": carriers.tolist(),
            "carriers_from": self._said("carriers_from") or "file",
            "carriers_found": self._said("carriers_found"),
            "grid": self._field.grid.tolist(),
            "frame_shape": self._said("shape") or [height, width],
            "doubts": list(self._said("doubts") or []),
            "arrays": [wire.describe_array("slices", slices, "1.0 = sensor white")],
        }
        return Message("slices", header, slices.data.cast("B"))

    def light_field(self, _index: int) -> LightField | None:
        return self._field

    def full_size(self, _index: int) -> FullSizePicture:
        """A frame's picture at the sensor's own resolution: a light field has none."""
        raise DappledError("a light field has views alone: `dappled picture` makes the frame's full-size picture")

    def _said(self, name: str) -> Any:
        return self._field.attributes.get(name)

    def _facts(self) -> dict[str, Any]:
        pose = {"source": "none", **dict.fromkeys(_NO_POSE)}
        return {
            "flight": self._name, "frame": 0, "utc_ns": None, "pose": pose,
            "focal_length_mm": self._said("focal_length_mm"), "f_number": self._said("f_number"),
            "camera": self._said("camera") or "", "mask": self._said("mask") or "", "law": self._said("law"),
            "sha256": None,
        }  # fmt: skip
