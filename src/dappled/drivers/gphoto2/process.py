"""The camera's own process: it owns libgphoto2 for one long session and obeys messages (`loop`).

libgphoto2 blocks for seconds, with the GIL held, when a camera goes silent; here that stalls nobody, and the parent
can always kill it.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import sys

from dappled.drivers.child_process import die_with_parent, raise_priority
from dappled.drivers.gphoto2.loop import CameraLoop
from dappled.drivers.gphoto2.messages import Before
from dappled.drivers.gphoto2.settings import parse_settings
from dappled.drivers.process_channel import ChannelError, ProcessChannel


def _quiet_library() -> None:
    """libgphoto2 writes to file descriptor 2 whenever a link breaks; our own errors keep the real one."""
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)
    os.close(null)


def main() -> None:
    """Arguments: the socket's descriptor, the parent's process id, settings and `Before` as JSON."""
    fd, parent, settings, before = sys.argv[1:]
    die_with_parent(int(parent))
    raise_priority()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ctrl-C reaches the whole group; the parent ends us
    _quiet_library()
    channel = ProcessChannel(socket.socket(fileno=int(fd)))
    try:
        CameraLoop(channel, parse_settings(json.loads(settings)), before=Before.of_json(json.loads(before))).run()
    except ChannelError:
        sys.exit(0)  # the parent is gone, or closed the channel


if __name__ == "__main__":
    main()
