#!/usr/bin/env python3
"""The wheel in a bare environment of this Python: it installs, flies a simulated frame and opens the light field.

    python3 tools/wheel_trial.py       builds in a folder that is removed; prints versions, size and times

Runs on a bare Python >= 3.11. Ends 1 with the command that failed.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import bootstrap

OPENED = """
import sys, dappled
field = dappled.open(sys.argv[1])
print(f"dappled {dappled.__version__}, Python {sys.version.split()[0]}: {field!r}")
"""


def main() -> None:
    uv = bootstrap.find_uv() or bootstrap.fetch_uv()
    with tempfile.TemporaryDirectory(prefix="wheel-trial-") as name:
        folder = Path(name)
        environment = {**os.environ, "HOME": name, "PATH": f"{folder / 'venv/bin'}:{os.environ['PATH']}"}

        def run(*command: str) -> str:
            done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
            if done.returncode:
                raise SystemExit(
                    f"{' '.join(command)}: exit {done.returncode}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"
                )
            return done.stdout

        began = time.monotonic()
        run(uv, "build", "--quiet", "--wheel", "--python", sys.executable, "--out-dir", name, str(bootstrap.ROOT))
        wheel = next(folder.glob("*.whl"))
        run(uv, "venv", "--quiet", "--python", sys.executable, "venv")
        python = str(folder / "venv/bin/python")
        run(uv, "pip", "install", "--quiet", "--python", python, str(wheel))
        installed = time.monotonic()
        size = sum(path.lstat().st_size for path in (folder / "venv").rglob("*") if path.is_file())
        run("dappled", "run", "--simulate", "--frames", "1")
        flight = next((folder / "flights").glob("*Z-*"))
        raw = next((flight / "frames").iterdir())
        field = folder / "field.npz"
        calibration = str(flight / "inputs/calibration.toml")
        run("dappled", "decode", str(raw), "--mask", "reference-5x5", "--calibration", calibration, "-o", str(field))
        print(run(python, "-c", OPENED, str(field)).strip())
        print(
            f"wheel {wheel.stat().st_size / 1e6:.1f} MB, environment {size / 1e6:.0f} MB on {platform.machine()}; "
            f"installed in {installed - began:.0f} s, flown and opened in {time.monotonic() - installed:.0f} s"
        )


if __name__ == "__main__":
    main()
