"""A stage on which the documents' commands are run as they are printed: the files that they name, and a live daemon."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tomli_w
from PIL import Image

from dappled.config import settings as configuration
from dappled.daemon.camera_protocol.ground_client import GroundClient, GroundStationError
from dappled.mocks.scene.masked_camera import reference_camera
from dappled.mocks.simulation import Simulation, World
from tests.simulated import lytro

ROOT = Path(__file__).resolve().parents[2]
DAPPLED = (sys.executable, "-m", "dappled")
FENCED = re.compile(r"^```(sh|console|bash)\n(.*?)^```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"(?:^ {4}\S.*\n)+", re.MULTILINE)
OURS = re.compile(r"^(dappled|make|python|sudo dappled|uv|pip) ")


def commands(document: Path) -> list[str]:
    """Every command of ours in a document, as printed, comments and continued lines resolved."""
    text = document.read_text(encoding="utf-8")
    blocks = [match[2] for match in FENCED.finditer(text)]
    outside = FENCED.sub("", text)
    blocks += [re.sub(r"^ {4}", "", match[0], flags=re.MULTILINE) for match in INDENTED.finditer(outside)]
    lines = []
    for block in blocks:
        for line in block.replace("\\\n", " ").splitlines():
            bare = re.sub(r"\s+#\s.*$", "", line).removeprefix("$ ").strip()
            if OURS.match(bare):
                lines.append(bare)
    return lines


SUBSTITUTES = {
    "white-f22.cr2 --mask mask-2": "white.dng --camera reference-36mm --mask reference-5x5",
    "-o calibration.toml": "-o calibration.toml --overwrite",  # the stage has one
    "/media/$USER/FINEPIX/DCIM": "DCIM",
    "~/flights/20261121T*": "build/demo/flights/*Z-*",
    "127.0.0.1:8042": "127.0.0.1:0",
    "/etc/dappled/dappled.toml": "dappled.toml",
    "/etc/dappled/left.toml": "dappled.toml",
    "/etc/dappled/right.toml": "dappled.toml",
    "COPY/FLIGHT": "FLIGHT",
    "offload COPY": "offload COPY --same-device",  # the test has one disk
}
"""What a real camera, card or day would have made, and what stands for it here."""

ELSEWHERE = {
    " --panel": "tests/cli/test_panel.py",
    "calibrate --kit": "tests/cli/calibrate/test_kit.py",  # frames behind two printed masks
    "calibrate --lens": "tests/products/test_chessboard.py",  # pictures of a chessboard
    "--camera my-450d.toml": "tests/products/test_chessboard.py",  # what comes of them
    "--refine orthophoto.tif": "tests/products/maps/test_georeference.py",  # a map of the place
    "--gcp points.csv": "tests/products/maps/test_georeference.py",  # control points of the place
    "--refine neighbours": "tests/products/maps/test_georeference.py",  # frames that overlap
    "--as terrain --gsd": "tests/products/maps/test_georeference.py",  # as above
    "--together": "tests/products/survey/test_flight_sweep.py",  # frames that overlap
    "dappled terrain volume": "tests/products/maps/test_volumes.py",  # two flights over one place
    "dappled terrain contours": "tests/products/maps/test_contours.py",  # a flight with heights
    "maps/ground.tif": "tests/products/maps/test_georeference.py",  # what comes of them
    "dappled open": "tests/cli/test_open.py",  # serves pages until Ctrl-C
    "--scheduler tcp:": "tests/products/batch/test_batch.py",  # a Dask cluster
    "trigger --distance": "tests/system/test_distance_trigger.py",  # settings that have a series
    "flight gnss": "tests/system/test_gnss_receiver.py",  # a receiver on a serial port
    "--panel": "tests/cli/test_panel.py",  # a frame with a panel of known reflectance
}
"""Commands that need more than this stage has, and the tests that give it to them."""

FINDINGS = {
    "dappled doctor": "NO GO",  # no-go: not every place on the stage has a camera
    "dappled depth --flight": "fly lower, or use pairs of frames",  # the demo's frames are at the limit of Eq 5
}
"""Commands that may end with 1 here because of what they find, and what they say then; the documents say so too."""


LIVE = re.compile(r"dappled (trigger|watch|status|doctor)\b")
"""Commands that ask a daemon that flies."""


@dataclass(frozen=True)
class Stage:
    """Where commands run. `short` is a folder for sockets."""

    folder: Path
    environment: dict[str, str]
    short: Path

    def all_fail(self, commands: Sequence[str]) -> list[str]:
        """Run a document's commands in order, `cd` and all; what those said that did not end well. Where one asks a
        daemon, one flies meanwhile."""
        said, where = [], self.folder
        with self._live() if any(map(LIVE.search, commands)) else nullcontext("") as port:
            for command in commands:
                failure = self.run(command, where, port)
                if failure:
                    said.append(failure)
                if into := re.search(r"&& cd (\S+)$", command):
                    where = where / into[1]
        return said

    def run(self, command: str, where: Path, port: str) -> str | None:
        """Run it; None when it went well, else what it said. `port`: of the ground link of the daemon that flies."""
        if command.startswith("make "):
            return self._make(command)
        for words, test in ELSEWHERE.items():
            if words in command:
                return None if (ROOT / test).is_file() else f"{command}: {test} is gone"
        words = command.replace("127.0.0.1:14550", f"127.0.0.1:{port}").removeprefix("sudo ")
        for printed, ours in SUBSTITUTES.items():
            words = words.replace(printed, ours)
        environment = self.environment
        if re.match(r"dappled( --\S+)* run ", words + " ") and "--frames" not in words:
            words += " --for 1"  # else it flies until somebody ends it
            environment = environment | {"RUNTIME_DIRECTORY": str(self.folder / "own")}  # the live one's is taken
        try:
            done = subprocess.run(
                ["/bin/bash", "-c", words],
                cwd=where,
                env=environment,
                capture_output=True,
                text=True,
                timeout=120,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"{command}\n  has not ended after 120 s"
        found = any(
            words.startswith(start) and done.returncode == 1 and sentence in done.stdout + done.stderr
            for start, sentence in FINDINGS.items()
        )
        well = done.returncode == 0 or found
        return None if well else f"{command}\n  exit {done.returncode}: {done.stderr.strip()[-600:]}"

    @contextmanager
    def _live(self) -> Iterator[str]:
        """A simulated daemon that photographs; the port of its ground link."""
        live = self.folder / "live"
        live.mkdir(exist_ok=True)
        with Simulation(World(), configuration.load(None), live) as settings:
            tables = configuration.to_tables(settings)
            stream = f"ipc://{self.short}/dappled/slices"
            tables["record"]["directory"] = str(live / "flights")
            tables["publish"] |= {"slices": stream, "ask": f"{stream}.ask"}
            (live / "live.toml").write_text(tomli_w.dumps(tables), encoding="utf-8")
            daemon = subprocess.Popen(
                [*DAPPLED, "run", "--config", "live.toml"], cwd=live, env=self.environment, stderr=subprocess.DEVNULL
            )
            try:
                ground = settings.mavlink.url[1].rpartition(":")[2]
                with GroundClient(f"udpout:127.0.0.1:{ground}", system_id=254) as client, shooting(client):
                    yield ground
            finally:
                daemon.terminate()
                daemon.wait(60)

    def _make(self, command: str) -> str | None:
        """The target is there; running it is what other tests and CI do."""
        done = subprocess.run(["/bin/sh", "-c", f"{command} -n"], cwd=ROOT, capture_output=True, text=True, check=False)
        return None if done.returncode == 0 else f"{command}: {done.stderr}"


def stage(folder: Path, short: Path, flight: Path) -> Stage:
    """Files by the names that documents use, among them a flight, which is copied. `short` is for sockets."""
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "HOME": str(folder),
        "XDG_RUNTIME_DIR": str(short),
        "RUNTIME_DIRECTORY": "",
    }
    _files(folder)
    flown = shutil.copytree(flight, folder / "flights" / flight.name)
    (folder / "FLIGHT").symlink_to(flown)
    (folder / "build/demo/flights").mkdir(parents=True)
    (folder / "build/demo/flights" / flight.name).symlink_to(flown)
    frame = sorted((flown / "frames").glob("*.dng"))[-1]
    for name in ("frame.dng", "FRAME"):
        shutil.copy(frame, folder / name)
    shutil.copy(flown / "inputs/calibration.toml", folder / "calibration.toml")
    designed = [*DAPPLED, "mask", "diffraction", "--mask", "mask-1", "--json"]
    spots = json.loads(subprocess.run(designed, check=True, capture_output=True).stdout)["impulses"]
    rows = "".join(f"{spot['x_mm']:.2f},{spot['y_mm']:.2f}\n" for spot in spots)
    (folder / "bench.csv").write_text("x_mm,y_mm\n" + rows, encoding="utf-8")
    return Stage(folder, environment, short)


@contextmanager
def shooting(client: GroundClient) -> Iterator[None]:
    """A photograph every few seconds, so that there is something to watch; never two under way, so that the documents'
    own find room on a machine that is slow."""
    client.find_camera(60)
    ended = threading.Event()

    def shoot() -> None:
        while not ended.wait(3.0):
            with suppress(GroundStationError):  # the daemon may be busy; the next one will do
                client.capture(1, timeout_s=20.0)

    thread = threading.Thread(target=shoot, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(30)


def _files(folder: Path) -> None:
    (folder / "dappled.toml").write_text('[record]\ndirectory = "flights"\n', encoding="utf-8")
    white = reference_camera(1, scale=0.5, scene="white").bench_frame().file
    for name in ("white.dng", "white-f22.dng", "bench.dng"):
        (folder / name).write_bytes(white)
    (folder / "DCIM").mkdir()
    for named in ("tools", "benchmarks"):
        (folder / named).symlink_to(ROOT / named)
    (folder / "docs/pictures").mkdir(parents=True)
    _lenslets(folder)
    (folder / "density.csv").write_text(
        "level,density\n" + "".join(f"{i * 17},{i * 0.2:.2f}\n" for i in range(16)), encoding="utf-8"
    )


def _lenslets(folder: Path) -> None:
    """A small plenoptic camera's frame and its white frame, as PNG and in Lytro's container."""
    y, x = np.mgrid[0:492, 0:492].astype(np.float64)
    light = sum(np.cos(2 * np.pi * 0.1 * (np.cos(a) * y + np.sin(a) * x)) for a in (0.001, np.pi / 3, 2 * np.pi / 3))
    white = 168 + 3000 * np.exp(0.8 * (light - 3) / 3)
    frame = 168 + (white - 168) * (0.7 + 0.2 * np.sin(x / 57) * np.cos(y / 43))
    for name, values in (("white.png", white), ("raw.png", frame)):
        Image.fromarray(values.astype(np.uint16)).save(folder / name)
    (folder / "frame.lfp").write_bytes(lytro.container(frame.astype(np.uint16), lytro.metadata(frame.shape)))
