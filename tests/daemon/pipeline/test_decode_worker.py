from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from dappled import codec
from dappled.daemon.pipeline.decode_worker import DecodeWorker, nearest
from dappled.decode.depth.depth_map import DepthMap
from dappled.decode.depth.ranging import Ranging
from dappled.decode.lightfield.falloff import Falloff
from dappled.drivers.child_process import ChannelMessage
from dappled.drivers.raw import law_check
from dappled.drivers.raw.darkroom import Darkroom
from dappled.drivers.raw.recipe import LawDecision, Recipe
from dappled.findings import Code, Finding, text
from dappled.products.opened import with_ranging
from tests.cli.test_thesis_camera import PROFILE, QUARTER, dng_of
from tests.decode.ray_frames import MASKS, Shot
from tests.products.fields import DISPARITY, light_field

Lens = tuple[float | None, float | None]  # focal length, mm, and f-number


@pytest.mark.parametrize(("length_mm", "known"), [(50.0, True), (12.8, False), (None, False)])
def test_no_distance_is_told_of_another_zoom(length_mm: float | None, known: bool) -> None:
    ranging = replace(Ranging.of_lens(50.0, 7.4, 0.01), focal_length_mm=length_mm)
    one = np.ones((60, 80), np.float32)
    found = DepthMap(np.float32(DISPARITY) * one, np.float32(0.01) * one, one, "")
    assert (nearest(with_ranging(light_field(), ranging), found) is not None) is known
    assert nearest(light_field(), found) is None


def ask(
    worker: DecodeWorker,
    path: Path,
    index: int,
    *,
    look: bool = True,
    lens: Lens = (None, None),
) -> Mapping[str, Any]:
    facts = {"path": str(path), "focal_length_mm": lens[0], "f_number": lens[1], "index": index, "look": look}
    answer, fds = worker(ChannelMessage({"do": "decode", **facts}))
    for fd in fds:
        os.close(fd)
    assert "error" not in answer
    return answer


def worker_of(recipe: Recipe) -> DecodeWorker:
    worker = DecodeWorker()
    worker(ChannelMessage({"do": "set up", "recipe": codec.plain(recipe), "preview_px": 64}))
    return worker


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Recipe, list[Path]]:
    """A recipe with the law `fd`, and frames by rays: one at full aperture, then two at f/22."""
    folder = tmp_path_factory.mktemp("flown")
    (folder / "quarter.toml").write_text(PROFILE)
    shot = Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, turn_deg=1.0, scene="texture", seed=2)
    shots = [replace(shot, f_number=1.8, exponent=1.1, snr=30.0), shot, replace(shot, seed=3)]
    frames = [dng_of(folder / f"{n}.dng", one, one.frame()) for n, one in enumerate(shots)]
    return Recipe(str(folder / "quarter.toml"), "mask-2", try_laws=True), frames


def test_the_law_that_the_carriers_obey_is_decided_once_a_flight(flown: tuple[Recipe, list[Path]]) -> None:
    recipe, frames = flown
    worker = worker_of(recipe)
    opened, stopped, later = (ask(worker, path, n) for n, path in enumerate(frames))
    assert (opened["law"], opened["carriers_found"], opened["decision"]) == ("fd", None, None)
    assert (stopped["law"], later["law"]) == ("geometric", "geometric")
    assert stopped["decision"]["first"] == 1
    assert "geometric 10^" in stopped["decision"]["sentence"]
    assert stopped["ms"]["laws"] > 0
    assert later["decision"] == stopped["decision"]  # with each frame, until the parent has recorded it
    assert "laws" not in later["ms"]
    assert stopped["carriers_found"] >= 4
    (at,) = [row[2:] for row in later["carriers"] if row[:2] == [1, 1]]
    true = (1, 1) @ Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, turn_deg=1.0).lattice
    assert np.abs((at - true) * QUARTER.shape).max() < 0.3
    # a replay goes by the flight's decision, and an older flight by what it was configured with: neither looks
    decided = codec.read(LawDecision, stopped["decision"])
    replayed = worker_of(replace(recipe, try_laws=False, decided=decided))
    for n in (2, 0, 1):
        assert ask(replayed, frames[n], n)["sha256"] == (opened, stopped, later)[n]["sha256"]
    older = ask(worker_of(replace(recipe, try_laws=False)), frames[1], 1)
    assert (older["law"], older["decision"]) == ("fd", None)
    assert "laws" not in older["ms"]


def test_carriers_that_must_be_seen_and_are_not_are_a_doubt_about_every_frame(
    flown: tuple[Recipe, list[Path]], tmp_path: Path
) -> None:
    shot = Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, scene="white")
    bare = dng_of(tmp_path / "bare.dng", shot, shot.without_film())
    worker = worker_of(flown[0])
    first, second = ask(worker, bare, 0), ask(worker, bare, 1)
    for one in (first, second):
        assert one["carriers_found"] == 0
        assert one["doubts"][0]["code"] == "carriers.unseen"
    assert "laws" in first["ms"]
    assert "laws" not in second["ms"]
    assert "laws" not in ask(worker_of(flown[0]), bare, 0, look=False)["ms"]


def test_vignetting_of_the_first_frame_with_a_lens_is_a_doubt_about_all(
    flown: tuple[Recipe, list[Path]], tmp_path: Path
) -> None:
    shot = Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, scene="white")
    y, x = (np.linspace(-1, 1, side) for side in QUARTER.shape)
    corners = 1 - 0.2 * (y[:, None] ** 2 + x**2)
    even, darker = (
        dng_of(tmp_path / f"{name}.dng", shot, plane)
        for name, plane in (("even", shot.frame()), ("darker", shot.frame() * corners))
    )
    for frames, doubted in (((even, darker), False), ((darker, even), True)):
        worker = worker_of(replace(flown[0], law="geometric", try_laws=False))
        for index, path in enumerate(frames):
            codes = [one["code"] for one in ask(worker, path, index)["doubts"]]
            assert ("frame.vignetted" in codes) is doubted


def test_what_bends_the_tones_of_a_frame_is_a_doubt_about_it(flown: tuple[Recipe, list[Path]], tmp_path: Path) -> None:
    """A JPEG; a PNG that says it has a gamma; pixels that are clipped: of those frames, and not of the next."""
    shot = Shot(MASKS["mask-2"], QUARTER, 85.0, 22.0, scene="texture", seed=2)
    plane = shot.frame()
    good = dng_of(tmp_path / "good.dng", shot, plane)
    clipped = dng_of(tmp_path / "clipped.dng", shot, np.clip(plane * 3.2, 0, 1.3))
    bent = Image.fromarray((255 * (plane / plane.max()) ** (1 / 2.2)).astype(np.uint8))
    bent.save(tmp_path / "bent.jpg", quality=95)
    chunk = PngInfo()
    chunk.add(b"gAMA", struct.pack(">I", 45455))
    bent.save(tmp_path / "bent.png", pnginfo=chunk)
    worker = worker_of(replace(flown[0], law="geometric", try_laws=False))
    frames = [good, tmp_path / "bent.jpg", tmp_path / "bent.png", clipped, good]
    told = [ask(worker, path, n, lens=(85.0, 22.0))["doubts"] for n, path in enumerate(frames)]
    assert told[0] == told[4] == []
    assert [(one["code"], one["facts"]["why"]["code"]) for one in told[1]] == [("frame.developed", "tones.jpeg")]
    gamma = codec.read(Finding, told[2][0])
    assert gamma.code is Code.FRAME_DEVELOPED
    assert str(text(gamma)).startswith("its gAMA chunk says that its values have a gamma of 1/2.2")
    assert "frame.clipped" in [one["code"] for one in told[3]]


def test_a_frame_that_tells_nothing_of_the_lens_does_not_tell_for_others(
    flown: tuple[Recipe, list[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A black one, as with the cap on; and each focal length is looked at once."""
    near, far = (
        dng_of(tmp_path / f"{f_mm:g}.dng", shot, shot.frame())
        for f_mm in (60.0, 85.0)
        for shot in [Shot(MASKS["mask-2"], QUARTER, f_mm, 22.0, scene="white")]
    )
    looked = iter((None, Falloff(0.0, 0.01, 4), Falloff(0.3, 0.01, 0)))
    monkeypatch.setattr(Darkroom, "lost_at_corners", lambda *_: next(looked))
    worker = worker_of(replace(flown[0], law="geometric", try_laws=False))
    doubted = [
        "frame.vignetted" in [one["code"] for one in ask(worker, path, index)["doubts"]]
        for index, path in enumerate((far, far, far, near, near))
    ]
    assert doubted == [False, False, False, True, True]


def test_a_search_that_fails_costs_no_frame_and_is_a_doubt_until_carriers_are_seen(
    flown: tuple[Recipe, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("singular matrix")

    recipe, frames = flown
    worker = worker_of(recipe)
    with monkeypatch.context() as patched:
        patched.setattr(law_check, "search_frame", fail)
        for index in (1, 2):
            found = ask(worker, frames[1], index)
            assert (found["law"], found["decision"]) == ("fd", None)
            assert found["doubts"][0]["code"] == "carriers.unsearched"
            assert "singular matrix" in found["doubts"][0]["facts"]["why"]["said"]
            assert len(found["sha256"]) == 64
