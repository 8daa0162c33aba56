"""`dappled watch`: print what arrives, ask again for what was lost, and save it on request."""

from __future__ import annotations

import argparse
import json
from contextlib import ExitStack
from pathlib import Path

from dappled.cli.arguments import seconds, whole
from dappled.cli.status import stream_endpoint
from dappled.cli.terminal import remark, waiting_for
from dappled.clock import SystemClock
from dappled.daemon.stream import watch
from dappled.daemon.stream.curve import ClientKeys, load_own, load_public
from dappled.daemon.stream.subscriber import Subscriber, reuse_large_blocks
from dappled.daemon.stream.wire import Message
from dappled.errors import DappledError, counted


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "example: dappled watch --save slices/ --count 8\n\nexits 1 if slices were lost, or fewer than --count arrived"
    )
    parser.add_argument(
        "endpoint",
        nargs="?",
        metavar="ENDPOINT",
        help="ZeroMQ endpoint of the stream (default: the daemon's on this machine)",
    )
    parser.add_argument(
        "--config", type=Path, metavar="FILE", help="the daemon's settings file, which names the endpoint"
    )
    parser.add_argument(
        "--ask", metavar="ENDPOINT", help="endpoint that answers requests (default: the one beside an ipc stream)"
    )
    parser.add_argument("--save", type=Path, metavar="DIR", help="save each frame's header, slices and mosaic here")
    parser.add_argument("--from-start", action="store_true", help="also fetch what the flight has sent already")
    parser.add_argument("--count", type=whole, metavar="N", help="end after the slices of N frames")
    parser.add_argument("--timeout", type=seconds, metavar="S", help="give up after S seconds without a message")
    parser.add_argument("--keys", type=Path, metavar="FILE", help="your NAME.key_secret, for a tcp endpoint")
    parser.add_argument("--server-key", type=Path, metavar="FILE", help="the vehicle's NAME.key")
    parser.add_argument("--json", action="store_true", help="print one JSON object per line")


def run(arguments: argparse.Namespace) -> int:
    endpoint = arguments.endpoint or stream_endpoint(arguments.config)
    ask = arguments.ask or (f"{endpoint}.ask" if endpoint.startswith("ipc://") else "")
    if bool(arguments.keys) != bool(arguments.server_key):
        raise DappledError("--keys and --server-key go together: your own secret key, and the vehicle's public one")
    keys = ClientKeys(load_own(arguments.keys), load_public(arguments.server_key)) if arguments.keys else None
    if arguments.save:
        arguments.save.mkdir(parents=True, exist_ok=True)
    reuse_large_blocks()
    with Subscriber(endpoint, ask, from_start=arguments.from_start, keys=keys) as subscriber, ExitStack() as silence:
        silence.enter_context(waiting_for(f"a daemon on {endpoint}"))

        def received(message: Message) -> None:
            silence.close()
            _show(message, arguments.json)

        seen = watch.watch(
            subscriber,
            received=received,
            new_frame=lambda message: watch.save(message, arguments.save) if arguments.save else None,
            count=arguments.count,
            silence_s=arguments.timeout,
            clock=SystemClock(),
        )
        if not arguments.json:
            asked_again = f"{subscriber.recovered} after a repeated request"
            print(f"{counted(seen.frames, 'frame')} received, {asked_again}, {subscriber.lost} lost")
        if not seen.messages:
            remark(f"nothing came from {endpoint}: is a daemon running there? `dappled status {endpoint}` asks it")
        elif seen.short_of(arguments.count):
            remark(f"too few slices came from {endpoint}: `dappled status {endpoint}` tells whether it decodes")
        return 1 if seen.short_of(arguments.count) or subscriber.lost else 0


def _show(message: Message, as_json: bool) -> None:
    header = message.header
    size = memoryview(message.body).nbytes if message.body is not None else 0
    if as_json:
        print(json.dumps({"topic": message.topic, **header, "body_bytes": size}), flush=True)
        return
    words = [f"{message.topic:8}", f"seq {header.get('seq')}"]
    if "frame" in header:
        words.append(f"frame {header['frame']}")
    if message.topic == "slices":
        words.append(" × ".join(str(n) for n in header["arrays"][0]["shape"]))
    if size:
        words.append(f"{size / 1e6:.1f} MB")
    if message.topic == "error":
        words.append(header.get("error", ""))
    if message.topic != "health":
        print("  ".join(words), flush=True)
