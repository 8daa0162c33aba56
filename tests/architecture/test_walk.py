"""How many modules a command and a frame pass, and that docs/modules.md lists them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.architecture import walk


@pytest.mark.long
def test_a_command_and_a_frame_pass_few_modules_and_the_page_lists_them(tmp_path: Path) -> None:
    walked = walk.fly(tmp_path)
    assert len(walked.command) <= walk.GROWTH * walk.RECORDED["command"], walked.command
    assert len(walked.frame) <= walk.GROWTH * walk.RECORDED["frame"], sorted(walked.frame)
    command, frame = walk.on_page(walk.PAGE.read_text(encoding="utf-8"))
    assert (set(command), set(frame)) == (set(walked.command), set(walked.frame)), "run `make walk`"


def test_the_page_lists_every_module() -> None:
    page = walk.PAGE.read_text(encoding="utf-8")
    assert walk.between(page, walk.MODULES) == walk.module_list(), "run `make walk`"


def test_a_trace_without_a_frame_is_an_error() -> None:
    step = walk.Step(1, "publisher", "daemon.stream.publisher", "Publisher.publish")
    with pytest.raises(walk.WalkError, match="decode worker"):
        walk.read([[step]])


def test_a_detour_is_counted() -> None:
    def way(at_ns: int, *modules: str) -> list[walk.Step]:
        names = ("", *modules, "")
        return [walk.Step(at_ns + place, "mavlink 0", name, "") for place, name in enumerate(names)]

    straight = ("drivers.mavlink.links", "daemon.pipeline.shutter", "drivers.gphoto2.client")
    steps = [step for at_ns in range(walk.FRAMES) for step in way(at_ns * 100, *straight)]
    assert walk.command_of(steps) == straight
    assert walk.command_of([*steps, *way(900, *straight, "errors")]) == (*straight, "errors")
