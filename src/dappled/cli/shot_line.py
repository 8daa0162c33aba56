"""One frame's story as a line for people, or as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import UTC, datetime

from dappled.daemon.pipeline.pending_shot import PendingShot
from dappled.daemon.stream import wire

_SHORT = {"wish to trigger": "wish", "trigger call": "call", "trigger to file": "file"}


def line(pending: PendingShot) -> str:
    """Index, trigger source, time, position, attitude, focal length, carriers found, size, milliseconds per stage."""
    cause = pending.shot.cause
    sequence = "" if cause.sequence is None else f" #{cause.sequence}"
    words = [f"{pending.shot.index:06d}", f"{cause.kind}{sequence} from {cause.source}"]
    if pending.tag:
        pose = wire.pose_face(pending.tag)
        words.append(datetime.fromtimestamp(pending.tag.utc_ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3])
        if pose["latitude_deg"] is None:
            words.append("no position")
        else:
            words.append(f"{pose['latitude_deg']:.7f} {pose['longitude_deg']:.7f} {pose['altitude_msl_m']:.2f} m")
        if pose["yaw_deg"] is None:
            words.append("no attitude")
        else:
            words.append(f"roll {pose['roll_deg']:.1f} pitch {pose['pitch_deg']:.1f} yaw {pose['yaw_deg']:.1f}")
        length = pending.tag.focal_length_mm
        words.append("focal length unknown" if length is None else f"{length:g} mm")
    if pending.decoded:
        done = pending.decoded
        words.append(f"{done.carriers_found}/{done.carriers_predicted} carriers ({done.carriers_from})")
    if pending.frame:
        words.append(f"{pending.frame.size / 1e6:.1f} MB")
    times = " ".join(f"{_SHORT.get(name, name)} {ms:.0f}" for name, ms in pending.ms.items())
    if times:
        words.append(f"ms: {times}")
    if pending.frame is None and pending.follows:
        words.append(pending.follows)
    if pending.problem:
        words.append(f"PROBLEM: {pending.problem}")
    return "  ".join(words)


def as_json(pending: PendingShot) -> str:
    """The same as one JSON object."""
    facts = {
        "index": pending.shot.index,
        "cause": asdict(pending.shot.cause),
        "frame": asdict(pending.frame) if pending.frame else None,
        "tag": asdict(pending.tag) if pending.tag else None,
        "carriers_found": pending.decoded.carriers_found if pending.decoded else None,
        "carriers_predicted": pending.decoded.carriers_predicted if pending.decoded else None,
        "carriers_from": pending.decoded.carriers_from if pending.decoded else None,
        "slices_sha256": pending.decoded.sha256 if pending.decoded else None,
        "ms": {**pending.ms, "decoder": dict(pending.decoded.ms) if pending.decoded else {}},
        "follows": pending.follows or None,
        "problem": pending.problem or None,
    }
    return json.dumps(facts)
