"""The decode process: `python -m dappled.daemon.pipeline.decode_worker FD PARENT`. Ends when its parent does."""

from __future__ import annotations

import hashlib
import io
import os
import signal
import socket
import sys
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image

from dappled.daemon.pipeline.decode_process import NICENESS, serve
from dappled.daemon.stream import wire
from dappled.decode import DecodeError
from dappled.decode.depth import RANGING, DepthMap, Ranging, estimate, evidence
from dappled.decode.lightfield import LightField, ViewStack
from dappled.decode.lightfield.light_field import slice_mosaic
from dappled.drivers.camera import Blob
from dappled.drivers.child_process import DECODER_GOES, ChannelMessage, end_with_parent, goes_first
from dappled.drivers.raw.darkroom import Darkroom, DecodeResult, Recipe
from dappled.errors import sentence

DEPTH_NICENESS = 14
WorkerReply = tuple[Mapping[str, Any], tuple[int, ...]]


class DecodeWorker:
    """Answers the parent's questions with a darkroom that it sets up once."""

    def __init__(self) -> None:
        self._darkroom: Darkroom | None = None
        self._preview_px = 1024

    def __call__(self, question: ChannelMessage) -> WorkerReply:
        body = question.body
        if body["do"] == "set up":
            self._darkroom = Darkroom(Recipe(**body["recipe"]))
            self._preview_px = body["preview_px"]
            return {}, ()
        assert self._darkroom is not None  # "set up" comes first
        try:
            if body["do"] == "warm up":
                self._darkroom.check()
                return {"ready": True}, ()
            if body["do"] == "depth":
                return _depth(self._darkroom, body)
            return self._decode(self._darkroom, body["path"], body["focal_length_mm"], body["f_number"])
        except Exception as error:  # noqa: BLE001  # no frame may end the worker: the next one may be good
            return {"error": _naming(body.get("path"), error)}, ()

    def _decode(
        self, darkroom: Darkroom, path: str, focal_length_mm: float | None, f_number: float | None
    ) -> WorkerReply:
        done = darkroom.decode(path, focal_length_mm=focal_length_mm, f_number=f_number, views=False)
        field = done.light_field
        ms = dict(done.ms)
        began = time.perf_counter()
        slices = np.ascontiguousarray(field.slices)
        data = memoryview(slices.data).cast("B")
        sha256 = hashlib.sha256(data).hexdigest()
        body = Blob.of(data, "slices")
        ms["hash"] = (time.perf_counter() - began) * 1e3
        began = time.perf_counter()
        preview, size = self._preview(slices, field.carriers)
        blob = Blob.of(preview, "preview")
        ms["preview"] = (time.perf_counter() - began) * 1e3
        facts = {
            "sha256": sha256,
            "arrays": [wire.describe_array("slices", slices, "1.0 = sensor white")],
            "carriers": field.carriers.tolist(),
            "carriers_from": done.report.carriers_from,
            "carriers_found": done.carriers_found,
            "carriers_predicted": done.carriers_predicted,
            "law": field.attributes["law"],
            "grid": field.grid.tolist(),
            "seen": _seen(done),
            "preview_size": list(size),
            "ms": ms,
        }
        return facts, (body.fd, blob.fd)

    def _preview(self, slices: Any, carriers: Any) -> tuple[bytes, tuple[int, int]]:
        step = max(1, round(max(slices.shape[1:]) * np.sqrt(2 * len(slices) - 1) / self._preview_px))
        mosaic = slice_mosaic(slices[:, ::step, ::step], carriers)
        file = io.BytesIO()
        Image.fromarray(mosaic).save(file, "JPEG", quality=80)
        return file.getvalue(), (mosaic.shape[1], mosaic.shape[0])


def _depth(darkroom: Darkroom, asked: Mapping[str, Any]) -> WorkerReply:
    """Disparity and its sigma of one frame, float32 (h, w) each, at a lower priority than decoding."""
    if os.nice(0) < DEPTH_NICENESS:
        os.nice(DEPTH_NICENESS - os.nice(0))
    done = darkroom.decode(asked["path"], focal_length_mm=asked["focal_length_mm"], f_number=asked["f_number"])
    field = done.light_field
    found = estimate.estimate(evidence.of_light_field(field), asked["method"])
    both = [np.ascontiguousarray(one, dtype=np.float32) for one in (found.disparity, found.sigma)]
    known = found.disparity[found.known]
    facts = {
        "nearest_m": nearest(field, found),
        "arrays": [
            wire.describe_array(name, one, "pixels of a view, from view to view")
            for name, one in zip(("disparity", "sigma"), both, strict=True)
        ],
        "range_px": [float(edge) for edge in np.quantile(known, [0.02, 0.98])] if known.size else None,
        "grid": field.grid.tolist(),
        "law": field.attributes["law"],
    }
    return facts, (Blob.of(np.stack(both).tobytes(), "depth").fd,)


def nearest(field: LightField, found: DepthMap) -> tuple[float, float] | None:
    """The nearest distance and its standard error, m; None where no calibration is for the lens as the frame has it."""
    ranging = field.attributes.get(RANGING)
    if not ranging:
        return None
    try:
        metres = Ranging.from_dict(ranging).at(*(field.attributes.get(k) for k in ("f_number", "focal_length_mm")))
    except DecodeError:
        return None  # another zoom: the autopilot gets no distance, rather than a wrong one
    return metres.distances(found, ViewStack.of(field)).nearest()


def _seen(done: DecodeResult) -> dict[str, Any]:
    """What a viewer needs to draw the spectrum and make views: see the schema of `slices`."""
    report = done.report
    named = report.carriers_from != "found"
    pairs = zip(report.predicted, report.measured, strict=True) if named else ()
    carriers = [
        {
            "at": [c.ky, c.kx, round(c.fy, 9), round(c.fx, 9)],
            "seen": m and [round(m.fy, 9), round(m.fx, 9), round(m.strength, 6)],
        }
        for c, m in pairs
    ]
    return {
        "frame_shape": done.light_field.attributes["shape"],
        "mosaic": done.raw.cfa is not None,
        "noise_rms": report.noise_rms,
        "predicted": carriers,
    }


def _naming(path: str | None, error: Exception) -> str:
    """The error's sentence, with the frame's file in it."""
    text = "there is not enough memory for it" if isinstance(error, MemoryError) else sentence(error)
    return text if path is None or path in text else f"{path}: {text}"


def main() -> None:
    """Arguments: the socket's descriptor, the parent's process id."""
    fd, parent = (int(word) for word in sys.argv[1:])
    end_with_parent(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a ^C is the parent's to act on
    os.nice(NICENESS)
    goes_first(DECODER_GOES)
    serve(socket.socket(fileno=fd), DecodeWorker())


if __name__ == "__main__":
    main()
