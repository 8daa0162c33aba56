"""Processes of their own for libgphoto2: started with one end of a channel, ended within a second."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys

from dappled.drivers.gphoto2.channel import Channel

_DEAD_S = 0.5


def spawn(module: str, *arguments: str, quiet: bool = False) -> tuple[subprocess.Popen[bytes], Channel]:
    """Start `python -m module`, its arguments the channel's descriptor, this process' id, and the ones given. `quiet`:
    what it writes to standard error is thrown away. Raises OSError."""
    channel, other = Channel.pair()
    with other:
        try:
            process = subprocess.Popen(
                [sys.executable, "-m", module, str(other.fileno()), str(os.getpid()), *arguments],
                pass_fds=(other.fileno(),),
                stdin=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL if quiet else None,
                # libgphoto2 keeps settings (capture target, ...) under HOME and would let one run change the next.
                env={**os.environ, "HOME": "/nonexistent"},
            )
        except OSError:
            channel.close()
            raise
    return process, channel


def end(process: subprocess.Popen[bytes], patience_s: float = 0.2) -> None:
    """Give it time to end by itself, then kill it. One that the kernel holds in a USB call dies later, and is not
    waited for."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(patience_s)
        return
    process.kill()
    with contextlib.suppress(subprocess.TimeoutExpired):  # as above
        process.wait(_DEAD_S)
