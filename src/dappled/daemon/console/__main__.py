"""The console's process: `python -m dappled.daemon.console CHANNEL_FD LISTENER_FD`. Ends when the daemon does."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import uvicorn
from starlette.types import ASGIApp

from dappled.daemon.console import app, background
from dappled.daemon.console.access import Access
from dappled.daemon.console.connection import CONNECTIONS, Connection
from dappled.daemon.console.control import Control
from dappled.daemon.console.feed import Feed
from dappled.daemon.console.hub import Hub
from dappled.daemon.console.parts import Parts
from dappled.daemon.console.studio import Studio
from dappled.daemon.health import log_format
from dappled.daemon.pipeline.memory import CONSOLE_GOES, goes_first, reuse_large_blocks
from dappled.drivers.process_channel import ProcessChannel
from dappled.drivers.raw.darkroom import Recipe
from dappled.errors import DappledError, report

NICENESS = 15  # below the decoder's 10: looking comes last
log = logging.getLogger(__name__)


def main() -> int:
    """Serve until the daemon ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a ^C is the daemon's to act on
    logging.basicConfig(level=logging.WARNING, handlers=[log_format.handler()])
    os.nice(NICENESS)
    goes_first(CONSOLE_GOES)
    reuse_large_blocks()
    channel = ProcessChannel(socket.socket(fileno=int(sys.argv[1])))
    listener = socket.socket(fileno=int(sys.argv[2]))
    first = channel.receive(10)
    if first is None:
        return 1
    asyncio.run(_serve(channel, listener, first.body))
    return 0


async def _serve(channel: ProcessChannel, listener: socket.socket, setup: Mapping[str, Any]) -> None:
    recipe = setup["recipe"]
    hub, studio = Hub(), Studio(None if recipe is None else Recipe(**recipe), setup["mount"])
    parts = Parts(
        feed=Feed(
            setup["endpoint"],
            setup["ask"],
            tell=hub.tell,
            thumb=studio.thumb,
            corners=studio.corners,
            watched=lambda: parts.watched(),  # noqa: PLW0108  # the parts are made around it
        ),
        hub=hub,
        studio=studio,
        control=Control(channel),
        access=Access(setup["token"], setup["hosts"]),
        background=_background(setup["map"]),
    )
    server = uvicorn.Server(configuration(app.make(parts)))
    tasks = [asyncio.create_task(parts.feed.run()), asyncio.create_task(app.follow_log(parts))]
    for task in tasks:
        task.add_done_callback(lambda done: _end(done, server))
    watcher = asyncio.create_task(_until_gone(parts.control, server))
    await server.serve(sockets=[listener])
    for task in (*tasks, watcher):
        task.cancel()
    await asyncio.gather(*tasks, watcher, return_exceptions=True)


def configuration(served: ASGIApp) -> uvicorn.Config:
    """How it is served: over connections that are few, and end by themselves when they ask for nothing."""
    return uvicorn.Config(
        served,
        log_config=None,
        access_log=False,
        lifespan="off",
        ws="none",
        http=Connection,
        loop="asyncio",
        server_header=False,
        timeout_keep_alive=10,
        timeout_graceful_shutdown=1,
        limit_concurrency=2 * CONNECTIONS,  # those that ask; and tasks of those that went end a moment later
        h11_max_incomplete_event_size=16_384,
    )


def _end(task: asyncio.Task[None], server: uvicorn.Server) -> None:
    """A part that ended takes the process with it: the daemon starts a whole one."""
    if not task.cancelled():
        if (error := task.exception()) is not None:
            report(log, "console", error)
        server.should_exit = True


async def _until_gone(control: Control, server: uvicorn.Server) -> None:
    """End the server when the daemon is gone: asked every second, as nothing else would tell."""
    loop = asyncio.get_running_loop()
    while not control.gone.is_set():
        await asyncio.sleep(1.0)
        try:
            await loop.run_in_executor(None, control.ask, {"do": "nothing"})
        except DappledError as error:
            log.info("%s", error)
    server.should_exit = True
    threading.Timer(3.0, os._exit, [1]).start()  # a browser that never lets go must not keep the process


def _background(file: str) -> background.Background | None:
    if not file:
        return None
    try:
        return background.load(Path(file))
    except DappledError as error:
        log.warning("%s", error)
        return None


if __name__ == "__main__":
    sys.exit(main())
