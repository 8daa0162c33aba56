"""The decode process: `python -m dappled.daemon.pipeline.decode_worker FD PARENT`. Ends when its parent does."""

from __future__ import annotations

import hashlib
import logging
import os
import signal
import socket
import sys
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from dappled import codec
from dappled.config import profiles
from dappled.config.profiles import VerdictBounds
from dappled.daemon.pipeline.decode_process import serve
from dappled.daemon.pipeline.picture_facts import FineDetail, PictureFacts, detail, fine_detail, noise_of
from dappled.daemon.stream import wire
from dappled.decode import DecodeError
from dappled.decode.depth import RANGING, DepthMap, Ranging, estimate, evidence
from dappled.decode.lightfield import LightField, ViewStack
from dappled.decode.lightfield.light_field import fingerprint, slice_mosaic
from dappled.decode.picture.shadow import shadow_at
from dappled.drivers.camera import Blob
from dappled.drivers.child_process import ChannelMessage, end_with_parent
from dappled.drivers.raw import recipe_check
from dappled.drivers.raw.darkroom import Darkroom, DecodeResult
from dappled.drivers.raw.frame_mosaic import mosaic_of
from dappled.drivers.raw.recipe import LawDecision, Recipe
from dappled.encoded_pictures import file_of
from dappled.errors import DappledError, sentence
from dappled.findings import FRAME, Code, Finding, finding
from dappled.shown import guard_output

if TYPE_CHECKING:
    from dappled.drivers.raw.picture_maker import PictureMaker

log = logging.getLogger(__name__)
VIEWERS_NICENESS = 14
PICTURE_PX = 2048  # of a picture's sides, at most: of larger frames the middle is shown
_JUDGED_PX = 448  # of the middle that tells how sharp a picture is
WorkerReply = tuple[Mapping[str, Any], tuple[int, ...]]


_LOOKS = 4  # at frames of different lens settings, in one flight: a search takes as long as some decodes


class DecodeWorker:
    """Answers the parent's questions with darkrooms that it sets up once: one for the recipe as configured, one for
    what a flight has decided, which holds from the frame on that decided it."""

    def __init__(self) -> None:
        self._darkroom: Darkroom | None = None
        self._decided: Darkroom | None = None
        self._recipe: Recipe | None = None
        self._pictures: PictureMaker | None = None  # made with what it needs, when the first picture is asked for
        self._preview_px = 1024
        self._looks = False
        self._laws = LawLooks()
        self._lens_seen: dict[tuple[float | None, float | None], list[Finding]] = {}
        self._sensors: dict[tuple[str, int, int], tuple[tuple[float, float], VerdictBounds] | None] = {}

    def __call__(self, question: ChannelMessage) -> WorkerReply:
        body = question.body
        if body["do"] == "set up":
            recipe = codec.read(Recipe, body["recipe"])
            plain = replace(recipe, try_laws=False, keep_law=False)
            self._darkroom = Darkroom(replace(plain, decided=None))
            self._recipe, self._pictures = recipe, None
            self._looks = recipe.try_laws and recipe.decided is None
            self._decided = None if recipe.decided is None else Darkroom(plain)
            self._preview_px = body["preview_px"]
            return {}, ()
        assert self._darkroom is not None  # "set up" comes first
        try:
            return self._made(self._darkroom, body)
        except MemoryError:
            return {"error": "there is not enough memory for it"}, ()
        except Exception as error:  # noqa: BLE001  # no frame may end the worker: the next one may be good
            return {"error": sentence(error)}, ()

    def _made(self, darkroom: Darkroom, asked: Mapping[str, Any]) -> WorkerReply:
        match asked["do"]:
            case "warm up":
                recipe_check.check(darkroom.recipe)
                return {"ready": True}, ()
            case "depth":
                return _depth(self._decided or darkroom, asked)
            case "picture":
                return self._full_picture(asked)
        return self._decode(darkroom, asked)

    def _full_picture(self, asked: Mapping[str, Any]) -> WorkerReply:
        """The picture of one frame at the sensor's own resolution, JPEG."""
        from dappled.drivers.raw import developing, picture_maker  # noqa: PLC0415  most workers never need them

        _give_way()
        assert self._recipe is not None
        self._pictures = maker = self._pictures or picture_maker.PictureMaker(self._recipe, PICTURE_PX)
        lens = {"focal_length_mm": asked["focal_length_mm"], "f_number": asked["f_number"]}
        made = maker.picture(asked["path"], **lens)
        height, width = made.picture.plane.shape
        facts = {
            "size": [width, height],
            "corner": list(made.corner),
            "frame_shape": list(made.sensor.shape),
            "shadow_from": made.picture.shadow.source.value,
            "doubts": codec.plain(made.doubts),
        }
        return facts, (Blob.of(developing.jpeg(made), "picture").fd,)

    def _decode(self, configured: Darkroom, asked: Mapping[str, Any]) -> WorkerReply:
        path, index = asked["path"], asked["index"]
        known = {"focal_length_mm": asked["focal_length_mm"], "f_number": asked["f_number"], "views": False}
        decided = self._decided.recipe.decided if self._decided is not None else None
        in_force = self._decided if decided is not None and index >= decided.first else None
        done = (in_force or configured).decode(path, **known)
        ms = dict(done.ms)
        if asked["look"] and self._looks and self._laws.wanted(done, index):
            began = time.perf_counter()
            decided = self._look(configured, path, known, index, done)
            if decided is not None:
                self._looks = False
                self._decided = Darkroom(replace(configured.recipe, decided=decided))
                done = self._decided.decode(path, **known)
            ms["laws"] = (time.perf_counter() - began) * 1e3
        field = done.light_field
        began = time.perf_counter()
        slices = np.ascontiguousarray(field.slices)
        data = memoryview(slices.data).cast("B")
        sha256 = hashlib.sha256(data).hexdigest()
        numbers = fingerprint(slices)
        body = Blob.of(data, "slices")
        ms["hash"] = (time.perf_counter() - began) * 1e3
        began = time.perf_counter()
        preview, size = self._preview(slices, field.carriers)
        blob = Blob.of(preview, "preview")
        ms["preview"] = (time.perf_counter() - began) * 1e3
        found, doubts = self._laws.judge(done)
        doubts += [*done.not_linear, *self._lens_doubts(configured, done)]
        began = time.perf_counter()
        try:
            picture = self._picture(configured, done, np.abs(slices[0]))
        except Exception as error:  # noqa: BLE001  # a frame must not be lost with what only its verdict needs
            log.warning("frame %d can't be judged: %s", index, sentence(error))
            picture = None
        ms["judge"] = (time.perf_counter() - began) * 1e3
        facts = {
            "sha256": sha256,
            "fingerprint": numbers,
            "arrays": [wire.describe_array("slices", slices, "1.0 = sensor white")],
            "carriers": field.carriers.tolist(),
            "carriers_from": done.report.carriers_from,
            "carriers_found": found,
            "carriers_predicted": done.carriers_predicted,
            "mask_nats": done.report.mask_nats,
            "law": field.attributes["law"],
            "grid": field.grid.tolist(),
            "seen": _seen(done),
            "doubts": codec.plain(doubts),
            "preview_size": list(size),
            "picture": codec.plain(picture),
            "ms": ms,
            "decision": None if decided is None or index < decided.first else codec.plain(decided),
        }
        return facts, (body.fd, blob.fd)

    def _lens_doubts(self, configured: Darkroom, done: DecodeResult) -> list[Finding]:
        """What is strange about the lens, by the first frame at this focal length and f-number that tells; without an
        f-number each frame may be at another stop, and tells for itself."""
        lens = _lens(done)
        if lens in self._lens_seen:
            return self._lens_seen[lens]
        lost = configured.lost_at_corners(done.light_field)
        if lost is None:
            return []
        vignetted = lost.finding()
        doubts = [] if vignetted is None else [vignetted]
        if None not in lens:
            self._lens_seen[lens] = doubts
        return doubts

    def _look(
        self, configured: Darkroom, path: str, known: Mapping[str, Any], index: int, done: DecodeResult
    ) -> LawDecision | None:
        """Search a frame near all laws; what it decides for the flight. A calibrated flight keeps to its calibration:
        what is found elsewhere is a doubt. None also where the search fails: the frame is decoded already (`done`), and
        in doubt."""
        self._laws.begin()
        looker = Darkroom(replace(configured.recipe, try_laws=True))
        calibrated = bool(configured.recipe.calibration)
        try:
            looked = looker.decode(path, **known)
        except Exception as error:  # noqa: BLE001  # a search that fails must not cost a good frame
            self._laws.fail(done, error)
            log.warning("frame %d was not searched near other laws: %s", index, sentence(error))
            return None
        self._laws.keep(looked, decides=not calibrated)
        return None if calibrated else looker.decision(looked, index)

    def _picture(self, darkroom: Darkroom, done: DecodeResult, mean: NDArray[np.float32]) -> PictureFacts:
        """What the frame is judged by, with the bounds of its camera's profile, where it has one."""
        rows, columns = done.light_field.attributes["shape"]
        key = done.raw.model or "", rows, columns
        if key not in self._sensors:
            try:
                profile = darkroom.camera(key[0])
                self._sensors[key] = profile.sensor((rows, columns)).size_mm, profile.verdict
            except DappledError:  # without a profile, or for another shape
                self._sensors[key] = None
        sigma = done.report.noise_rms or 0.0
        noise = noise_of(mean, sigma * (mean.size / (rows * columns)) ** 0.5)
        exposed, known = done.exposed, self._sensors[key]
        seen = PictureFacts(exposed.clipped_share, exposed.black_share, exposed.mean_share, detail(mean), noise)
        if known is None:
            return seen
        if darkroom.recipe.mask != profiles.LENSLET:
            staggered = darkroom.camera(key[0]).staggered(done.raw.mosaic.shape)
            seen = replace(seen, fine=_fine(done, staggered=staggered))
        side_mm, bounds = known
        pixel_mm = side_mm[0] / rows, side_mm[1] / columns
        (down, _, _), (_, right, _) = done.light_field.grid.tolist()
        view_mm = abs(down) * pixel_mm[0], abs(right) * pixel_mm[1]
        return replace(seen, side_mm=side_mm, view_mm=view_mm, pixel_mm=pixel_mm, bounds=bounds)

    def _preview(self, slices: Any, carriers: Any) -> tuple[bytes, tuple[int, int]]:
        step = max(1, round(max(slices.shape[1:]) * np.sqrt(2 * len(slices) - 1) / self._preview_px))
        mosaic = slice_mosaic(slices[:, ::step, ::step], carriers)
        return file_of(mosaic, "JPEG", quality=80), (mosaic.shape[1], mosaic.shape[0])


def _fine(done: DecodeResult, *, staggered: bool) -> FineDetail:
    """What the picture at the sensor's own resolution has of detail in the frame's middle, in the colour of most of its
    samples. In focus each slice is the mean one times what the mask's shadow has of its carrier."""
    field = done.light_field
    mosaic, corner = mosaic_of(done.raw, _JUDGED_PX, staggered=staggered)
    middle = np.array(corner) + (np.array(mosaic.shape) - 1) / 2
    mean, others, carriers = field.slices[0], field.slices[1:], field.carriers[1:]
    shares = np.array([np.vdot(mean, one) for one in others]) / max(float(np.vdot(mean, mean).real), 1e-30)
    turned = np.asarray(shares * np.exp(2j * np.pi * carriers[:, 2:] @ middle), dtype=np.complex128)
    places = list(mosaic.places())
    most = max(places, key=lambda one: sum(other.colour == one.colour for other in places)).colour
    sigma, samples = np.float32(done.report.noise_rms or 0.0), []
    for place in places:
        if place.colour == most:
            known = shadow_at(place, mosaic.shape, carriers[:, 2:], turned)
            samples.append((mosaic.plane[place.cut] / known, sigma / known))
    return fine_detail(samples, places[0].step)


class LawLooks:
    """Which frames of a flight were searched near all laws, and what is known since then.

    A frame that shows no carriers where they are predicted is searched, one for each focal length and f-number and
    `_LOOKS` in all, until one shows them: there, or where a search finds them.
    """

    def __init__(self) -> None:
        self._last = -1
        self._settled = False
        self._left = _LOOKS
        self._unseen: dict[tuple[float | None, float | None], tuple[bool, Finding | None]] = {}  # observable, doubt

    def wanted(self, done: DecodeResult, index: int) -> bool:
        """Whether to search this frame. Not one that was taken before another one that is decoded already."""
        in_order, self._last = index > self._last, max(index, self._last)
        if done.report.carriers_from == "measured":  # one peak near a prediction may be the scene's
            self._settled = True
        length, stop = _lens(done)
        blind = length is not None and done.report.carriers_from in ("predicted", "calibrated")
        new = stop is None or _lens(done) not in self._unseen  # without an f-number each frame may be at another stop
        return in_order and blind and new and not self._settled and self._left > 0

    def begin(self) -> None:
        """Count a search, before it may fail."""
        self._left -= 1

    def keep(self, looked: DecodeResult, *, decides: bool) -> None:
        """Keep what a searched frame showed: carriers that stand elsewhere, if that `decides`, or why none was seen."""
        self._settled = decides and looked.search is not None and looked.search.found is not None
        if not self._settled:
            self._unseen[_lens(looked)] = looked.observable, looked.contradiction or looked.unsettled

    def fail(self, done: DecodeResult, why: Exception) -> None:
        """Keep that the search of a frame failed: whether its carriers stand elsewhere is not known."""
        self._unseen[_lens(done)] = True, finding(Code.CARRIERS_UNSEARCHED, FRAME, why=why)

    def judge(self, done: DecodeResult) -> tuple[int | None, list[Finding]]:
        """How many carriers a frame shows, None where none can be seen with its lens so; and what is in doubt."""
        doubts = [*done.report.doubts, *done.calibration_doubts]
        if done.report.carriers_from == "measured" or _lens(done) not in self._unseen:
            return done.carriers_found, doubts
        observable, missing = self._unseen[_lens(done)]
        found = done.carriers_found if observable or done.report.found > 1 else None
        return found, doubts if missing is None else [missing, *doubts]


def _lens(done: DecodeResult) -> tuple[float | None, float | None]:
    attributes = done.light_field.attributes
    return attributes.get("focal_length_mm"), attributes.get("f_number")


def _depth(darkroom: Darkroom, asked: Mapping[str, Any]) -> WorkerReply:
    """Disparity and its sigma of one frame, float32 (h, w) each."""
    _give_way()
    lens = {"focal_length_mm": asked["focal_length_mm"], "f_number": asked["f_number"]}
    done = darkroom.decode(asked["path"], **lens, joint_views=False)
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
        "doubts": codec.plain(done.doubts),
    }
    return facts, (Blob.of(np.stack(both).tobytes(), "depth").fd,)


def _give_way() -> None:
    """To the flight's own frames: what is made for viewers has a lower priority than decoding."""
    if os.nice(0) < VIEWERS_NICENESS:
        os.nice(VIEWERS_NICENESS - os.nice(0))


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
        "histogram": [round(one, 5) for one in done.exposed.histogram],
        "clipped_share": round(done.exposed.clipped_share, 6),
    }


def main() -> None:
    """Arguments: the socket's descriptor, the parent's process id."""
    fd, parent = (int(word) for word in sys.argv[1:])
    end_with_parent(parent)
    guard_output()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a ^C is the parent's to act on
    serve(socket.socket(fileno=fd), DecodeWorker())


if __name__ == "__main__":
    main()
