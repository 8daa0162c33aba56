"""`dappled watch`: what arrives, gaps asked for again, optionally saved."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from PIL import Image

from dappled.cli.common import seconds, stream, whole
from dappled.daemon.curve import ClientKeys, KeyFileError, load_own, load_public
from dappled.daemon.memory import reuse_large_blocks
from dappled.daemon.subscriber import Subscriber
from dappled.daemon.wire import Message
from dappled.decode.pictures import slice_mosaic


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = "example: dappled watch --save slices/ --count 8"
    parser.add_argument(
        "endpoint", nargs="?", help="ZeroMQ endpoint of the stream (default: the daemon's on this machine)"
    )
    parser.add_argument("--ask", help="endpoint that answers questions (default: beside an ipc stream)")
    parser.add_argument("--save", type=Path, metavar="DIR", help="keep each frame's header, slices and mosaic here")
    parser.add_argument("--from-start", action="store_true", help="also what the flight sent before this began")
    parser.add_argument("--count", type=whole, metavar="N", help="end after the slices of N frames")
    parser.add_argument("--timeout", type=seconds, metavar="S", help="give up after S seconds without a message")
    parser.add_argument("--keys", type=Path, metavar="FILE", help="your NAME.key_secret, for a tcp endpoint")
    parser.add_argument("--server-key", type=Path, metavar="FILE", help="the vehicle's NAME.key")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")


def run(arguments: argparse.Namespace) -> int:
    endpoint = arguments.endpoint or stream(None)
    ask = arguments.ask or (f"{endpoint}.ask" if endpoint.startswith("ipc://") else "")
    if arguments.save:
        arguments.save.mkdir(parents=True, exist_ok=True)
    reuse_large_blocks()
    frames: set[tuple[str, int]] = set()
    ended = False
    if bool(arguments.keys) != bool(arguments.server_key):
        raise KeyFileError("--keys and --server-key go together: your own secret key, and the vehicle's public one")
    keys = ClientKeys(load_own(arguments.keys), load_public(arguments.server_key)) if arguments.keys else None
    with Subscriber(endpoint, ask, from_start=arguments.from_start, keys=keys) as subscriber:
        heard = time.monotonic()
        while not (ended and not subscriber.waiting_for) and (arguments.count is None or len(frames) < arguments.count):
            message = subscriber.receive(0.5)
            if message is None:
                if arguments.timeout and time.monotonic() - heard > arguments.timeout:
                    break
                continue
            heard = time.monotonic()
            ended = ended or message.topic == "end"
            _show(message, arguments.json)
            if message.topic == "slices":
                key = (message.header["flight"], message.header["frame"])
                if key not in frames:
                    frames.add(key)
                    if arguments.save:
                        save(message, arguments.save)
        if not arguments.json:
            print(
                f"{len(frames)} frames received, {subscriber.recovered} of them asked for again, {subscriber.lost} lost"
            )
        wanted = 1 if arguments.count is None and not ended else arguments.count or 0
        short = len(frames) < wanted
        return 1 if short or subscriber.lost else 0


def save(message: Message, folder: Path) -> None:
    """Header as JSON, slices as NPY, and the mosaic of the slices as PNG (Fig 43), named by the frame."""
    stem = folder / f"{message.header['frame']:06d}"
    slices = message.arrays()["slices"]
    carriers = np.array(message.header["carriers"])
    stem.with_suffix(".json").write_text(json.dumps(message.header, indent=2))
    np.save(stem.with_suffix(".npy"), slices)
    Image.fromarray(slice_mosaic(slices, carriers)).save(stem.with_suffix(".png"))


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
