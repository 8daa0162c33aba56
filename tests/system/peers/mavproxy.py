"""MAVProxy with its camera module, typed at as a pilot types."""

from __future__ import annotations

import os
import re
import subprocess
import threading
import time
from pathlib import Path

PYTHON = Path(__file__).resolve().parents[3] / ".venv-peers" / "bin" / "python"  # `make peers` sets it up


class MavProxy:
    """Use as a context manager. `type` sends a line; `until` waits for words that were printed since."""

    def __init__(self, port: int, folder: Path) -> None:
        self._process = subprocess.Popen(
            [
                str(PYTHON), "-W", "ignore", str(PYTHON.with_name("mavproxy.py")),
                "--master", f"udpout:127.0.0.1:{port}",
                "--default-modules=cmdlong,camera,ftp", "--streamrate=-1", "--source-system=255", "--target-system=1",
                f"--state-basedir={folder}",
            ],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, cwd=folder,
            env={**os.environ, "HOME": str(folder), "PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        self._text = ""
        self._mark = 0
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, daemon=True)

    def __enter__(self) -> MavProxy:
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait(10)
        self._reader.join(10)
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()

    def type(self, line: str) -> None:
        assert self._process.stdin is not None
        with self._changed:
            self._mark = len(self._text)
        self._process.stdin.write(line.encode() + b"\n")
        self._process.stdin.flush()

    def until(self, pattern: str, timeout_s: float = 30.0) -> re.Match[str]:
        """The first match since the last line was typed."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while True:
                if match := re.compile(pattern).search(self._text, self._mark):
                    return match
                left = deadline - time.monotonic()
                assert left > 0, f"MAVProxy never said {pattern!r}:\n{self._text[self._mark :]}"
                self._changed.wait(left)

    def _read(self) -> None:
        assert self._process.stdout is not None
        while data := os.read(self._process.stdout.fileno(), 65536):
            with self._changed:
                self._text += data.decode("utf-8", "replace")
                self._changed.notify_all()
