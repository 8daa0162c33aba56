"""What a simulated body's pictures are: the simulated camera's raw files, patterns of bytes, or a file."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path

from dappled.mocks.body.body import BodyOptions
from dappled.mocks.body.eos450d import Expose


def pattern(shot_number: int, size: int) -> bytes:
    """Bytes that differ from shot to shot and from page to page, so that nothing lost or swapped goes unseen."""
    page = bytes(range(256)) * 16
    stamps = (f"shot {shot_number:06d} page {number:08d} ".encode() for number in range(size // len(page) + 1))
    return b"".join(stamp + page[len(stamp) :] for stamp in stamps)[:size]


def exposer(options: BodyOptions) -> Expose:
    """The source of pictures that the options name. Raises ValueError for one that isn't there."""
    if options.picture == "simulated":
        return _simulated(options)
    if options.picture.startswith("pattern:"):
        _, size, extension = options.picture.split(":")
        return _delayed(options.delay_s, lambda number: pattern(number, int(size)), extension)
    path = Path(options.picture)
    if not path.is_file():
        raise ValueError(f"picture {options.picture!r} is neither simulated, nor pattern:SIZE:EXT, nor a file")
    data = path.read_bytes()
    return _delayed(options.delay_s, lambda _number: data, path.suffix[1:])


def _delayed(delay_s: float, make: Callable[[int], bytes], extension: str) -> Expose:
    def expose(_trigger_monotonic_ns: int, shot_number: int) -> tuple[bytes, str]:
        data = make(shot_number)
        time.sleep(delay_s)
        return data, extension

    return expose


def _simulated(options: BodyOptions) -> Expose:
    # Imported here: it brings the whole renderer, which a body that shows patterns doesn't need.
    from dappled.mocks.scene.masked_camera import reference_camera  # noqa: PLC0415  # reason above

    start_ns = time.monotonic_ns() if options.start_monotonic_ns is None else options.start_monotonic_ns
    camera = reference_camera(
        options.seed,
        scale=options.scale,
        scene=options.scene,
        law=options.law,
        epoch_utc_s=time.time() + options.clock_offset_s - (time.monotonic_ns() - start_ns) / 1e9,
    )

    def expose(trigger_monotonic_ns: int, shot_number: int) -> tuple[bytes, str]:
        trigger_t_s = (trigger_monotonic_ns - start_ns) / 1e9
        made = camera.expose(trigger_t_s, shot_number, f_number=options.f_number)
        if options.truth is not None:
            made.truth.save(options.truth / f"{shot_number:06d}.npz")
            times = {"trigger_t_s": trigger_t_s, "mid_exposure_t_s": made.mid_exposure_t_s, "latency_s": made.latency_s}
            (options.truth / f"{shot_number:06d}.json").write_text(json.dumps(times), encoding="utf-8")
        return made.file, made.name_suffix.lstrip(".")

    return expose
