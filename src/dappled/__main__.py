"""The command `dappled`, also as `python -m dappled`. An interruption while it loads ends it at once, in silence."""

from __future__ import annotations

import os
import signal
import sys

INTERRUPTED = 130


def main() -> int:
    """Run the command line; returns its exit code."""
    signal.signal(signal.SIGINT, lambda *_: os._exit(INTERRUPTED))  # nothing is there yet to end in order
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices here are small, and work is shared among own threads
    len(bytes(1 << 22))  # from now on glibc keeps what imports free: 900 page faults less, of 10 000, until READY
    from dappled.cli import main as command  # noqa: PLC0415  # it loads for a second
    from dappled.shown import guard_output  # noqa: PLC0415  # as above

    guard_output()

    try:
        return command(loaded=lambda: signal.signal(signal.SIGINT, signal.default_int_handler))
    except KeyboardInterrupt:  # while it told how the verb had failed
        return INTERRUPTED
    finally:
        # An interruption that passed through exec() of a text, as dataclasses are made by, is remembered though it was
        # caught, and `python -m` ends by SIGINT instead of with the code. The next such exec() forgets it.
        exec("")  # noqa: S102


if __name__ == "__main__":
    sys.exit(main())
