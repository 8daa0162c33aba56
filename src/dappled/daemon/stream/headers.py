"""The headers of messages: of a flight's start, and about a frame, the same whether live, replayed or asked for."""

from __future__ import annotations

from dappled import __version__
from dappled.config.settings import Settings
from dappled.daemon.pipeline.decode_process import DecodedFrame
from dappled.daemon.pipeline.pending_shot import Names
from dappled.daemon.stream import wire
from dappled.flight.records import Frame, Tag


def start_header(settings: Settings, names: Names, utc_ns: int) -> dict[str, object]:
    """The facts of a `start` message."""
    return {
        "utc_ns": utc_ns,
        "software": f"dappled {__version__}",
        "camera": names.camera,
        "mask": names.mask,
        "slices": settings.publish.slices,
        "ask": settings.publish.ask,
    }


def slices_header(tag: Tag, decoded: DecodedFrame) -> dict[str, object]:
    """The facts of a `slices` message, live or asked for."""
    return {
        **wire.frame_facts(tag, decoded.law),
        "carriers": decoded.carriers,
        "carriers_from": decoded.carriers_from,
        "carriers_found": decoded.carriers_found,
        "grid": decoded.grid,
        **decoded.seen,
        "slices_sha256": decoded.sha256,
        "arrays": decoded.arrays,
    }


def frame_header(tag: Tag, frame: Frame, law: str | None) -> dict[str, object]:
    """The facts of a `frame` message, live or asked for."""
    return {
        **wire.frame_facts(tag, law),
        "utc_sigma_ns": tag.utc_sigma_ns,
        "time_source": tag.time_source,
        "exposure_s": tag.exposure_s,
        "iso": tag.iso,
        "name": frame.name,
        "size": frame.size,
    }
