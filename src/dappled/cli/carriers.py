"""`dappled carriers`: where the carriers should be, and where they are."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from dappled.cli import common
from dappled.config import profiles
from dappled.config.schema import ConfigError
from dappled.decode import pictures
from dappled.decode.carriers import LAWS, Carrier, Lattice
from dappled.decode.lattice import FoundLattice, find_lattice
from dappled.decode.masks import Mask, Order
from dappled.decode.peaks import Measured
from dappled.decode.plane import Plane
from dappled.decode.slices import default_size
from dappled.decode.spectrum import Spectrum, padded_shape
from dappled.drivers import rawfile
from dappled.drivers.darkroom import Darkroom, DarkroomError


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n  dappled carriers frame.dng --mask reference-5x5 --picture spectrum.png\n"
        "  dappled carriers --shape 2776 3688 --camera fujifilm-s5200 --mask mask-2 --focal-length 13\n"
        "  dappled carriers lytro.png --mask lenslet"
    )
    common.frames(parser, "?")
    common.add_recipe(parser)
    parser.add_argument("--shape", type=int, nargs=2, metavar=("H", "W"), help="predict only, for frames of this size")
    parser.add_argument("--picture", type=Path, metavar="FILE.png", help="draw the spectrum with its boxes")
    parser.add_argument("--json", action="store_true", help="as JSON")


@dataclass(frozen=True, slots=True)
class Table:
    """What is printed: the carriers of both half planes, and what was seen of each."""

    shape: tuple[int, int]
    law: str
    focal_length_mm: float | None
    lattice: Lattice
    rows: Sequence[tuple[Carrier, Measured | None]]
    main: frozenset[Order]
    found: FoundLattice | None = None


def run(arguments: argparse.Namespace) -> int:
    plane = None
    if arguments.frames is None:
        table = _predicted(arguments)
    else:
        plane, table = _measured(arguments)
    if arguments.picture:
        if plane is None:
            raise DarkroomError("--picture draws a frame's spectrum: name the frame")
        Image.fromarray(picture(plane, table)).save(arguments.picture)
    print(json.dumps(_as_json(table), indent=2) if arguments.json else _as_text(table))
    return 0


def picture(plane: Plane, table: Table) -> Any:
    """The spectrum with a box a slice, uint8 RGB (Fig 42)."""
    half = [(c, m) for c, m in table.rows if (c.ky, c.kx) >= (0, 0) and c.on_sensor]
    high, wide = padded_shape(table.shape)
    size = default_size(table.lattice, (high, wide))
    return pictures.spectrum_boxes(
        plane, [c for c, _ in half], (size[0] / high, size[1] / wide), measured=[m for _, m in half]
    )


def _predicted(arguments: argparse.Namespace) -> Table:
    if not arguments.shape or arguments.camera == "auto" or arguments.mask == profiles.LENSLET:
        raise ConfigError("without a frame --shape, --camera and --mask say what to predict for")
    if not arguments.focal_length or arguments.focal_length <= 0:
        raise ConfigError("without a frame --focal-length says, in mm, what to predict for")
    camera, mask = profiles.camera(arguments.camera), profiles.mask(arguments.mask).mask
    shape = (arguments.shape[0], arguments.shape[1])
    law = arguments.law or camera.law
    lattice = LAWS[law](mask, camera.sensor(shape), camera.mask_distance_mm, arguments.focal_length)
    rows = [(carrier, None) for carrier in lattice.carriers(mask.orders())]
    return Table(shape, law, arguments.focal_length, lattice, rows, _main(mask))


def _measured(arguments: argparse.Namespace) -> tuple[Plane, Table]:
    darkroom = Darkroom(common.recipe(arguments))
    raw = rawfile.read(arguments.frames)
    with darkroom.naming(arguments.frames):
        plane = darkroom.plane(raw)
        shape = (plane.shape[0], plane.shape[1])
        if arguments.mask == profiles.LENSLET:
            found = find_lattice(Spectrum.of(plane, workers=2))
            pairs = list(zip(found.carriers, found.measured, strict=True))
            rows = _both_halves([(Carrier(0, 0, 0.0, 0.0), measure_mean()), *pairs])
            return plane, Table(shape, "found", None, found.lattice, rows, frozenset(found.orders), found)
        decoder = darkroom.mask_decoder(shape, raw.camera_model or "")
        length = arguments.focal_length or raw.focal_length_mm
        if length is None:
            raise DarkroomError(f"{arguments.frames} doesn't say its focal length: give --focal-length MM")
        spectrum = decoder.transform(plane, length)
        predicted = decoder.predict(length)
        _, seen, _ = decoder.locate(spectrum, length, predicted)
        known = {(c.ky, c.kx): m for c, m in zip(predicted, seen, strict=True)}
        lattice = decoder.lattice_at(length)
        halves = lattice.carriers(decoder.mask.half_orders())
        rows = _both_halves([(c, known.get((c.ky, c.kx))) for c in halves])
        return plane, Table(shape, decoder.law, length, lattice, rows, _main(decoder.mask))


def measure_mean() -> Measured:
    """The mean of a frame, which is always there."""
    return Measured(0.0, 0.0, 1.0, 0.0, 1.0, False)


def _both_halves(half: Sequence[tuple[Carrier, Measured | None]]) -> list[tuple[Carrier, Measured | None]]:
    """The whole plane from one half: a frame is real, so the other half is its conjugate."""
    others = [(Carrier(-c.ky, -c.kx, -c.fy, -c.fx), m and m.twin()) for c, m in half if (c.ky, c.kx) != (0, 0)]
    return sorted([*half, *others], key=lambda row: (row[0].ky, row[0].kx))


def _main(mask: Mask) -> frozenset[Order]:
    """The orders that Fig 14's mask is meant to make: its diagonals. The others are crossed orders of Eq 11."""
    return frozenset(order for order in mask.orders() if abs(order[0]) == abs(order[1]))


def _as_json(table: Table) -> dict[str, Any]:
    carriers = []
    for carrier, seen in table.rows:
        row, column = carrier.index(table.shape)
        entry: dict[str, Any] = {
            "ky": carrier.ky,
            "kx": carrier.kx,
            "fy": carrier.fy,
            "fx": carrier.fx,
            "row": row,
            "col": column,
            "main": (carrier.ky, carrier.kx) in table.main or (-carrier.ky, -carrier.kx) in table.main,
            "on_sensor": carrier.on_sensor,
            "measured": None,
        }
        if seen is not None:
            at = Carrier(carrier.ky, carrier.kx, seen.fy, seen.fx).index(table.shape)
            entry["measured"] = {
                "fy": seen.fy,
                "fx": seen.fx,
                "row": at[0],
                "col": at[1],
                "strength": seen.strength,
                "phase_rad": seen.phase_rad,
                "phase_pattern": seen.phase_pattern,
                "suspect": seen.suspect,
            }
        carriers.append(entry)
    whole: dict[str, Any] = {
        "shape": list(table.shape),
        "law": table.law,
        "focal_length_mm": table.focal_length_mm,
        "carriers": carriers,
    }
    if table.found:
        whole["pitch_px"] = list(table.found.spacing_px)
        whole["rotation_rad"] = table.found.rotation_rad
    return whole


def _as_text(table: Table) -> str:
    lines = [f"{'ky':>3} {'kx':>3} {'row':>9} {'col':>9}   {'seen row':>9} {'seen col':>9} {'strength':>8}"]
    for carrier, seen in table.rows:
        row, column = carrier.index(table.shape)
        line = f"{carrier.ky:3d} {carrier.kx:3d} {row:9.2f} {column:9.2f}"
        if not carrier.on_sensor:
            line += "   off the sensor"
        elif seen is not None:
            at = Carrier(0, 0, seen.fy, seen.fx).index(table.shape)
            line += f"   {at[0]:9.2f} {at[1]:9.2f} {seen.strength:8.4f}{'  suspect' if seen.suspect else ''}"
        lines.append(line)
    seen_count = sum(m is not None for _, m in table.rows)
    if table.found:
        pitch = " × ".join(f"{p:.2f}" for p in table.found.spacing_px)
        lines.append(f"a lattice of {pitch} px, turned by {table.found.rotation_rad * 57.29578:.2f}°, residual "
                     f"{table.found.residual_bins:.2f} bins; {seen_count} carriers")  # fmt: skip
    else:
        lines.append(
            f"law {table.law}, focal length {table.focal_length_mm:g} mm; {seen_count} of {len(table.rows)} seen"
        )
    return "\n".join(lines)
