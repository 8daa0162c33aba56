"""Build a replay from the parts of a live flight, and play a recording through them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass

from dappled.config.settings import PublishSettings, Settings
from dappled.daemon.body_plan import exposure_of, plan_of
from dappled.daemon.navigation import BodyLatency
from dappled.daemon.pipeline.capture import PendingShots, ShotEnds
from dappled.daemon.pipeline.decode_process import DecodeProcess
from dappled.daemon.pipeline.pipeline import Decoding, Pipeline
from dappled.daemon.pipeline.recipes import Names
from dappled.daemon.pipeline.verdicts import FixedPlan, Judge
from dappled.daemon.replay import replay
from dappled.daemon.replay.replay import Pace, RecordedFlight, RecordedTelemetry, ReplayProgress
from dappled.daemon.replay.verifier import ReplayVerifier
from dappled.daemon.stream import wire
from dappled.daemon.stream.answers import Answers
from dappled.daemon.stream.publisher import Publisher
from dappled.drivers.camera import Identity
from dappled.drivers.raw.recipe import Recipe
from dappled.drivers.replay import ReplayCamera
from dappled.findings import Finding

_DECODE_QUEUE = 1000
_STOP_S = 5.0


@dataclass(frozen=True, slots=True)
class FlownWith:
    """What the tags of a replay are made with: names of camera and mask, the body's latency, the flight's settings; and
    the recipe by which frames are decoded, None: they aren't."""

    names: Names
    latency: BodyLatency
    settings: Settings
    recipe: Recipe | None = None


def run(
    recording: RecordedFlight,
    writer: ReplayVerifier,
    progress: ReplayProgress,
    flown: FlownWith,
    *,
    publish: PublishSettings | None = None,
    pace: Pace | None = None,
    report: Callable[[Finding], object] = lambda _: None,
) -> None:
    """Play the recording to its end (see `replay.play`), and close what was opened for it.

    `writer` takes the results, `report` what is to be said of the telemetry. Without `publish` nothing is
    published. Raises DappledError.
    """
    time = replay.clock(recording)
    body = flown.settings.body
    plan = FixedPlan({} if body.check == "off" else exposure_of(plan_of(body)))
    with ExitStack() as stack:
        decoder = None
        if flown.recipe is not None:
            decoder = DecodeProcess(flown.recipe)
            stack.callback(decoder.close)
            decoder.warm_up()
        telemetry = RecordedTelemetry(
            flown.settings,
            recording.telemetry,
            recording.horizons,
            recording.vehicles,
            report=report,
            bounds=recording.bounds,
            doubt=recording.doubt,
        )
        publisher = None
        if publish is not None:
            publisher = _open_publisher(publish, writer, decoder, stack)
            header = wire.start_header(publish, time.utc_ns(), camera=flown.names.camera, mask=flown.names.mask)
            publisher.publish("start", header)
        camera = ReplayCamera(recording.files, Identity("dappled", "recording", "", str(recording.root)), time)
        shots = PendingShots(camera)
        pose = flown.settings.pose
        judge = Judge(pose.mount, on_gimbal=pose.on_gimbal, plan=plan)
        ends = ShotEnds(shots, writer, progress)
        decoding = Decoding(ends, decoder, publisher, capacity=_DECODE_QUEUE, judge=judge)
        pipeline = Pipeline(decoding, telemetry, flown.latency, flown.names)
        pipeline.start()
        stack.callback(pipeline.stop, _STOP_S)
        replay.play(recording, shots, progress, time=time, pace=pace)
        for one in telemetry.findings():
            report(one)
        if publisher is not None:
            counts = {"wished": len(recording.shots), "safe": progress.frames}
            publisher.publish("end", {"utc_ns": time.utc_ns(), "shots": counts})
            publisher.stop()  # answer the last questions while the decoder still runs


def _open_publisher(
    publish: PublishSettings, writer: ReplayVerifier, decoder: DecodeProcess | None, stack: ExitStack
) -> Publisher:
    """A publisher that runs, and answers questions from the record, until the stack is closed."""
    publisher, answers = Publisher.of(publish), Answers(writer, decoder)
    stack.callback(answers.stop)
    answers.start()
    stack.callback(publisher.stop)
    publisher.start(writer.root.absolute().name, answers.answer)
    return publisher
