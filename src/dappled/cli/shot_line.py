"""One frame's story as a line for people, or as JSON."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import UTC, datetime

from dappled.daemon.pipeline.pending_shot import Story
from dappled.daemon.stream import wire

_SHORT = {"wish to trigger": "wish", "trigger call": "call", "trigger to file": "file"}


def line(story: Story) -> str:
    """Index, trigger source, time, position, attitude, focal length, carriers found, size, milliseconds per stage."""
    cause = story.shot.cause
    sequence = "" if cause.sequence is None else f" #{cause.sequence}"
    words = [f"{story.shot.index:06d}", f"{cause.kind}{sequence} from {cause.source}"]
    if story.tag:
        pose = wire.pose_face(story.tag)
        words.append(datetime.fromtimestamp(story.tag.utc_ns / 1e9, UTC).strftime("%H:%M:%S.%f")[:-3])
        if pose["latitude_deg"] is None:
            words.append("no position")
        else:
            words.append(f"{pose['latitude_deg']:.7f} {pose['longitude_deg']:.7f} {pose['altitude_msl_m']:.2f} m")
        if pose["yaw_deg"] is None:
            words.append("no attitude")
        else:
            words.append(f"roll {pose['roll_deg']:.1f} pitch {pose['pitch_deg']:.1f} yaw {pose['yaw_deg']:.1f}")
        length = story.tag.focal_length_mm
        words.append("focal length unknown" if length is None else f"{length:g} mm")
    if story.developed:
        done = story.developed
        words.append(f"{done.carriers_found}/{done.carriers_predicted} carriers ({done.carriers_from})")
    if story.frame:
        words.append(f"{story.frame.size / 1e6:.1f} MB")
    times = " ".join(f"{_SHORT.get(name, name)} {ms:.0f}" for name, ms in story.ms.items())
    if times:
        words.append(f"ms: {times}")
    if story.frame is None and story.follows:
        words.append(story.follows)
    if story.problem:
        words.append(f"PROBLEM: {story.problem}")
    return "  ".join(words)


def as_json(story: Story) -> str:
    """The same as one JSON object."""
    facts = {
        "index": story.shot.index,
        "cause": asdict(story.shot.cause),
        "frame": asdict(story.frame) if story.frame else None,
        "tag": asdict(story.tag) if story.tag else None,
        "carriers_found": story.developed.carriers_found if story.developed else None,
        "carriers_predicted": story.developed.carriers_predicted if story.developed else None,
        "carriers_from": story.developed.carriers_from if story.developed else None,
        "slices_sha256": story.developed.sha256 if story.developed else None,
        "ms": {**story.ms, "decoder": dict(story.developed.ms) if story.developed else {}},
        "follows": story.follows or None,
        "problem": story.problem or None,
    }
    return json.dumps(facts)
