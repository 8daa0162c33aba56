"""`dappled calibrate --lens`: fit distance, principal point and distortion, and write them into a camera profile."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dappled import durable
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, flag, option
from dappled.errors import DappledError, counted

if not words_only:
    import numpy as np
    import tomli_w
    from numpy.typing import NDArray

    from dappled.config import profiles
    from dappled.drivers.raw.darkroom import Darkroom, naming
    from dappled.drivers.raw.recipe import Recipe
    from dappled.products import chessboard


def board_size(text: str) -> tuple[int, int]:
    """The inner corners of a chessboard, columns and rows, written as 9x6. Raises ValueError."""
    columns, _, rows = text.lower().partition("x")
    size = (int(columns), int(rows)) if columns.isdecimal() and rows.isdecimal() else (0, 0)
    if min(size) < 3:
        raise ValueError(f"{text}: give its inner corners as 9x6, at least three on each side")
    return size


@dataclass(frozen=True, kw_only=True)
class LensArguments:
    """--lens and --board."""

    lens: bool = flag(
        "--lens",
        "the frames show a chessboard: calibrate the lens, and write a copy of the camera's profile with the result "
        "(-o FILE.toml)",
        group="lens, for maps",
    )
    board: tuple[int, int] = option(
        "--board", "inner corners of the chessboard", (9, 6), metavar="CxR", group="lens, for maps", parse=board_size,
        otherwise="9x6",
    )  # fmt: skip


def calibrated(
    recipe: Recipe,
    frames: list[Path],
    size: tuple[int, int],
    to: Path,
    *,
    focal_length_mm: float | None,
    output: Output,
) -> Report:
    """Calibrate from frames, which are decoded if a mask is named. Says the names of frames without the board."""
    if to.suffix != ".toml":
        raise DappledError(f"{to}: the name of a camera profile must end in .toml")
    darkroom = Darkroom(recipe)
    seen: list[NDArray[np.float64]] = []
    grids: list[NDArray[np.float64]] = []
    model, shape = "", (0, 0)
    length = focal_length_mm
    for path in output.each(frames):
        image, grid, raw_shape, raw_model, raw_length = _picture(darkroom, path, focal_length_mm)
        if shape not in ((0, 0), raw_shape):
            raise DappledError(f"{path} is {_size(raw_shape)}, the others {_size(shape)}: calibrate frames of one size")
        if length is not None and raw_length is not None and abs(raw_length / length - 1) > 0.01:
            raise DappledError(f"{path} was taken at {raw_length:g} mm, the others at {length:g}: one length at a time")
        shape, model, length = raw_shape, raw_model, length or raw_length
        found = chessboard.corners(image, size)
        if found is None:
            output.remark(f"no whole board in {path}")
            continue
        seen.append(found)
        grids.append(grid)
    if length is None:
        raise DappledError("the frames don't say their focal length: give --focal-length")
    profile = darkroom.camera(model)
    fit = chessboard.fit(seen, grids, board=size, sensor=profile.sensor(shape), focal_length_mm=length)
    write(recipe.camera if recipe.camera != "auto" else profile.name, fit.lens, to)
    y, x = fit.lens.principal_point_mm
    lines = [
        f"{counted(fit.boards, 'board')}, residual {fit.residual_um:.2f} µm on the chip",
        f"v = {fit.lens.v_mm:.3f} ± {fit.v_sigma_mm:.3f} mm at {length:g} mm, principal point {y:+.3f}, {x:+.3f} mm",
        "k1, k2, p1, p2, k3 = " + ", ".join(f"{number:.5g}" for number in fit.lens.distortion),
        f"written to {to}",
    ]
    values = {"boards": fit.boards, "residual_um": fit.residual_um, "v_mm": fit.lens.v_mm, "v_sigma_mm": fit.v_sigma_mm}
    return Report({**values, "principal_point_mm": [y, x], "distortion": list(fit.lens.distortion)}, lines)


def _picture(
    darkroom: Darkroom, path: Path, focal_length_mm: float | None
) -> tuple[NDArray[np.float32], NDArray[np.float64], tuple[int, int], str, float | None]:
    """The picture to search: behind a mask the decoded mean, else the frame itself."""
    if darkroom.recipe.mask:
        made = darkroom.decode(path, focal_length_mm=focal_length_mm, views=False)
        rows, columns = made.light_field.attributes["shape"]
        image = np.ascontiguousarray(made.light_field.slices[0].real)
        length = focal_length_mm or made.raw.focal_length_mm
        return image, made.light_field.grid, (int(rows), int(columns)), made.raw.model or "", length
    raw = darkroom.read(path)
    with naming(path):
        plane = darkroom.plane(raw)
    grid = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    length = focal_length_mm or raw.focal_length_mm
    return np.asarray(plane), grid, (plane.shape[0], plane.shape[1]), raw.model or "", length


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[0]} × {shape[1]} px"


def write(camera: str, lens: profiles.Lens, to: Path) -> None:
    """Write a copy of a camera's profile with this lens."""
    tables = profiles.tables(camera, "cameras")
    others = [one for one in tables.get("lens", []) if abs(one["focal_length_mm"] / lens.focal_length_mm - 1) > 0.01]
    mine = {
        "focal_length_mm": lens.focal_length_mm,
        "v_mm": lens.v_mm,
        "principal_point_mm": list(lens.principal_point_mm),
        "distortion": list(lens.distortion),
    }
    tables["lens"] = sorted([*others, mine], key=lambda one: float(one["focal_length_mm"]))
    durable.write_file(to, tomli_w.dumps(tables).encode())
