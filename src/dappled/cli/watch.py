"""`dappled watch`: print what arrives, ask again for what was lost, and save it on request."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from dappled.cli.status import stream_endpoint, to_endpoint
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, Verb, argument, flag, option
from dappled.clock import SystemClock
from dappled.errors import CallError, counted

if not words_only:
    from dappled.cli.terminal import waiting_for
    from dappled.daemon.stream import watch
    from dappled.daemon.stream.curve import ClientKeys, load_own, load_public
    from dappled.daemon.stream.subscriber import Subscriber
    from dappled.daemon.stream.wire import Message
    from dappled.large_blocks import reuse_large_blocks


@dataclass(frozen=True, kw_only=True)
class WatchStream(Verb):
    """Subscribe to the stream."""

    examples = ("dappled watch --save slices/ --count 8",)
    notes = "exits 1 if slices were lost, or fewer than --count arrived"

    endpoint: str | None = argument(
        "ENDPOINT",
        "ZeroMQ endpoint of the stream (default: the daemon's on this machine)",
        default=None,
        parse=to_endpoint,
    )  # fmt: skip
    config: Path | None = option("--config", "the daemon's settings file, which names the endpoint", None)
    ask: str | None = option(
        "--ask",
        "endpoint that answers requests",
        None,
        metavar="ENDPOINT",
        otherwise="the one beside an ipc stream",
        parse=to_endpoint,
    )
    save: Path | None = option("--save", "save each frame's header, slices and mosaic here", None, metavar="DIR")
    from_start: bool = flag("--from-start", "also fetch what the flight has sent already")
    count: int | None = option("--count", "end after the slices of N frames", None, low=1)
    timeout: float | None = option("--timeout", "give up after this time in silence", None, unit="s", low=0)
    keys: Path | None = option("--keys", "your NAME.key_secret, for a tcp endpoint", None)
    server_key: Path | None = option("--server-key", "the vehicle's NAME.key", None)
    json: bool = flag("--json", "print one JSON object per line")

    def check(self) -> None:
        if bool(self.keys) != bool(self.server_key):
            raise CallError("--keys and --server-key go together: your own secret key, and the vehicle's public one")

    def run(self, output: Output) -> Report:
        endpoint = self.endpoint or stream_endpoint(self.config)
        ask = self.ask or (f"{endpoint}.ask" if endpoint.startswith("ipc://") else "")
        keys = ClientKeys(load_own(self.keys), load_public(self.server_key)) if self.keys and self.server_key else None
        if self.save:
            self.save.mkdir(parents=True, exist_ok=True)
        reuse_large_blocks()
        with Subscriber(endpoint, ask, from_start=self.from_start, keys=keys) as subscriber, ExitStack() as silence:
            silence.enter_context(waiting_for(f"a daemon on {endpoint}"))

            def received(message: Message) -> None:
                silence.close()
                _show(message, output)

            seen = watch.watch(
                subscriber,
                received=received,
                new_frame=lambda message: watch.save(message, self.save) if self.save else None,
                count=self.count,
                silence_s=self.timeout,
                clock=SystemClock(),
            )
            if not seen.messages:
                output.remark(
                    f"nothing came from {endpoint}: is a daemon running there? `dappled status {endpoint}` asks it"
                )
            elif seen.short_of(self.count):
                output.remark(
                    f"too few slices came from {endpoint}: `dappled status {endpoint}` tells whether it decodes"
                )
            asked_again = f"{subscriber.recovered} after a repeated request"
            said = f"{counted(seen.frames, 'frame')} received, {asked_again}, {subscriber.lost} lost"
            if subscriber.unsent:
                said += f"; the daemon left out {subscriber.unsent}, since it could not keep up: decode the flight"
            return Report(None, [said], failed=bool(seen.short_of(self.count) or subscriber.lost or subscriber.unsent))


def _show(message: Message, output: Output) -> None:
    header = message.header
    size = memoryview(message.body).nbytes if message.body is not None else 0
    words = [f"{message.topic:8}", f"seq {header.get('seq')}"]
    if "frame" in header:
        words.append(f"frame {header['frame']}")
    if message.topic == "slices":
        words.append(" × ".join(str(n) for n in header["arrays"][0]["shape"]))
    if size:
        words.append(f"{size / 1e6:.1f} MB")
    if message.topic == "error":
        words.append(header.get("error", ""))
    values = {"topic": message.topic, **header, "body_bytes": size}
    output.row(values, *([] if message.topic == "health" else ["  ".join(words)]))
