#!/usr/bin/env python3
"""Check that every onboard library has an aarch64 wheel (glibc 2.36) for a Raspberry Pi, and print their size."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from bootstrap import ROOT, fetch_uv, find_uv

LIMIT_MB = 350
PLATFORM, PYTHON = "aarch64-manylinux_2_36", "3.11"  # Raspberry Pi OS 12


def main() -> int:
    uv = find_uv() or fetch_uv()
    with tempfile.TemporaryDirectory() as folder:
        wanted = ["--python-platform", PLATFORM, "--python-version", PYTHON, "--only-binary", ":all:", "--no-deps"]
        lock = ["--require-hashes", "-r", str(ROOT / "requirements-onboard.lock")]
        subprocess.run([uv, "pip", "install", "-q", *wanted, *lock, "--target", folder], check=True)
        # As tools/install.py leaves them: without the libraries' own tests.
        files = [path for path in Path(folder).rglob("*") if path.is_file() and "tests" not in path.parts]
        packages = len(list(Path(folder).glob("*.dist-info")))
        size_mb = sum(path.stat().st_size for path in files) / 1e6
    print(f"aarch64, Python {PYTHON}: {packages} onboard packages, all as wheels, {size_mb:.0f} MB installed")
    if size_mb > LIMIT_MB:
        print(f"more than the {LIMIT_MB} MB that onboard may take: move something to an extra", file=sys.stderr)
    return size_mb > LIMIT_MB


if __name__ == "__main__":
    sys.exit(main())
