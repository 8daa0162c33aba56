"""The console's process: `python -m dappled.daemon.console CHANNEL_FD PARENT LISTENER_FD`. It ends with the daemon."""

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

from dappled import codec
from dappled.daemon.console import placement
from dappled.daemon.console.access import Access
from dappled.daemon.console.app import ConsoleApp
from dappled.daemon.console.connection import BACKLOG, CONNECTIONS, Connection
from dappled.daemon.console.feed import Feed, Hub
from dappled.daemon.console.process import DaemonChannel
from dappled.daemon.console.seen_ground import SeenGround
from dappled.daemon.console.studio import Studio
from dappled.daemon.health import systemd
from dappled.decode.geometry import area
from dappled.drivers.child_process import ProcessChannel
from dappled.drivers.raw.recipe import Recipe
from dappled.errors import DappledError, report
from dappled.large_blocks import reuse_large_blocks
from dappled.shown import guard_output

NICENESS = 15  # below the decoder's 10
log = logging.getLogger(__name__)


def main() -> int:
    """Serve until the daemon ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the daemon handles ^C
    guard_output()
    logging.basicConfig(level=logging.WARNING, handlers=[systemd.handler()])
    os.nice(NICENESS)
    reuse_large_blocks()
    channel = ProcessChannel(socket.socket(fileno=int(sys.argv[1])))
    listener = socket.socket(fileno=int(sys.argv[3]))
    first = channel.receive(10)
    if first is None:
        return 1
    asyncio.run(_serve(channel, listener, first.body))
    return 0


async def _serve(channel: ProcessChannel, listener: socket.socket, setup: Mapping[str, Any]) -> None:
    studio = Studio(setup["recipe"] and codec.read(Recipe, setup["recipe"]), setup["mount"])
    feed = Feed(setup["endpoint"], setup["ask"], Hub(), studio, run=setup["run"], area=_area(setup["area"]))
    daemon = DaemonChannel(channel)
    rules = Access(setup["token"], setup["hosts"])
    app = ConsoleApp(feed, studio, daemon, rules, _background(setup["map"]))
    server = uvicorn.Server(configuration(app.asgi()))
    tasks = [asyncio.create_task(feed.run()), asyncio.create_task(app.follow_log())]
    for task in tasks:
        task.add_done_callback(lambda done: _end(done, server))
    waiting = asyncio.create_task(_until_gone(daemon, rules, feed.hub, server))
    await server.serve(sockets=[listener])
    for task in (*tasks, waiting):
        task.cancel()
    await asyncio.gather(*tasks, waiting, return_exceptions=True)


def configuration(served: ASGIApp) -> uvicorn.Config:
    """The server's configuration: few connections, which are closed when they ask for nothing."""
    logging.getLogger("uvicorn.error").addFilter(worth_logging)
    return uvicorn.Config(
        served,
        log_config=None,
        access_log=False,
        lifespan="off",
        ws="none",
        http=Connection,
        loop="asyncio",
        server_header=False,
        proxy_headers=False,  # X-Forwarded-For is whatever the client says
        backlog=BACKLOG,
        timeout_keep_alive=10,
        timeout_graceful_shutdown=1,
        limit_concurrency=2 * CONNECTIONS,  # twice, because the tasks of closed ones end a moment later
        h11_max_incomplete_event_size=16_384,
    )


def worth_logging(record: logging.LogRecord) -> bool:
    """Whether a line of uvicorn's is no mere sign of the end: it cancels requests that are not answered by then, such
    as one that waits for the decoder, and logs a traceback of each. It warns only of what a peer sends, each time anew:
    `Connection` counts that."""
    if record.levelno == logging.WARNING:
        return False
    error = record.exc_info[1] if record.exc_info else None
    return not isinstance(error, asyncio.CancelledError) and "graceful shutdown" not in record.getMessage()


def _end(task: asyncio.Task[None], server: uvicorn.Server) -> None:
    """End the process with any task that ends: the daemon starts it again."""
    if not task.cancelled():
        if (error := task.exception()) is not None:
            report(log, "console", error)
        server.should_exit = True


async def _until_gone(daemon: DaemonChannel, rules: Access, hub: Hub, server: uvicorn.Server) -> None:
    """End the server when the daemon has ended: ask every second, because nothing else would show it. Log refusals."""
    loop = asyncio.get_running_loop()
    while not daemon.gone.is_set():
        await asyncio.sleep(1.0)
        rules.settle()
        Connection.refusals.settle()
        try:
            await loop.run_in_executor(None, daemon.ask, {"do": "nothing"})
        except DappledError as error:
            log.info("%s", error)
    hub.close()  # a stream that the server cancels ends with a traceback
    server.should_exit = True
    threading.Timer(3.0, os._exit, [1]).start()  # a browser that keeps its connection must not keep the process


def _background(file: str) -> placement.Background | None:
    if not file:
        return None
    try:
        return placement.load_background(Path(file))
    except DappledError as error:
        log.warning("%s", error)
        return None


def _area(file: str) -> SeenGround | None:
    if not file:
        return None
    try:
        return SeenGround(area.read(Path(file)))
    except DappledError as error:
        log.warning("%s", error)
        return None


if __name__ == "__main__":
    sys.exit(main())
