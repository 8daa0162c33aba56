"""Run the daemon in a process of its own, restart it when it dies, and measure its resources."""

from __future__ import annotations

import os
import signal
import subprocess
from dataclasses import dataclass
from pathlib import Path

from dappled.drivers.python_command import python_module

END_S = 20.0


@dataclass(frozen=True, slots=True)
class Resources:
    """What the daemon holds: memory of its own process, open files, threads, and its child processes."""

    rss_mb: float
    files: int
    threads: int
    children: int

    def grown(self, after: Resources) -> list[str]:
        """A sentence for each resource that has grown by more than 3 files, 2 threads, or 10 % and 16 MB."""
        said = []
        if after.rss_mb > 1.1 * self.rss_mb + 16:
            said.append(f"memory grew from {self.rss_mb:.0f} to {after.rss_mb:.0f} MB")
        for name, slack in (("files", 3), ("threads", 2), ("children", 0)):
            was, now = getattr(self, name), getattr(after, name)
            if now > was + slack:
                said.append(f"{name} grew from {was} to {now}")
        return said


class Supervised:
    """`dappled run --config FILE`, kept alive. Its output goes to `log`. Use as a context manager."""

    def __init__(self, config: Path, log: Path) -> None:
        self._command = python_module("dappled", "run", "--config", str(config))
        self._log = log
        self._process: subprocess.Popen[bytes] | None = None
        self.lives = 0

    def __enter__(self) -> Supervised:
        self.keep_alive()
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.kill()
            self._process.wait(END_S)

    @property
    def pid(self) -> int:
        """The daemon's process."""
        assert self._process is not None
        return self._process.pid

    def keep_alive(self) -> None:
        """Start it if it doesn't run."""
        if self._process is None or self._process.poll() is not None:
            self.lives += 1
            with self._log.open("ab") as log:
                self._process = subprocess.Popen(self._command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def kill(self) -> None:
        """kill -9."""
        assert self._process is not None
        self._process.kill()
        self._process.wait(END_S)

    def children(self) -> dict[int, str]:
        """Its child processes: number → command line."""
        return children_of(self.pid)

    def resources(self) -> Resources:
        """Its resources now."""
        status = Path(f"/proc/{self.pid}/status").read_text(encoding="ascii", errors="replace")
        facts = dict(line.split(":", 1) for line in status.splitlines() if ":" in line)
        return Resources(
            rss_mb=int(facts["VmRSS"].split()[0]) / 1e3,
            files=len(os.listdir(f"/proc/{self.pid}/fd")),
            threads=int(facts["Threads"]),
            children=len(self.children()),
        )

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        assert self._process is not None
        self._process.send_signal(number)

    def end(self) -> int:
        """Send SIGTERM; returns the exit code. Raises subprocess.TimeoutExpired after 20 s."""
        assert self._process is not None
        self._process.terminate()
        return self._process.wait(END_S)


def children_of(pid: int) -> dict[int, str]:
    """The child processes of a process: number → command line."""
    found = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text(encoding="ascii").split():
            line = Path(f"/proc/{child}/cmdline").read_bytes().replace(b"\0", b" ")
            found[int(child)] = line.decode(errors="replace")
    return found
