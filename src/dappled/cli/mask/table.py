"""`dappled mask table`: print where the carriers are over focal lengths."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import asdict

from dappled.cli.mask import arguments as mask_arguments
from dappled.cli.mask.arguments import Installed
from dappled.decode.optics import carrier_tables
from dappled.decode.optics.lenses import within
from dappled.decode.optics.visibility import order_strengths

HELP = "print where the carriers are over focal lengths (Tables 11 and 14)"
EXAMPLE = "dappled mask table --mask mask-2 --camera fujifilm-s5200"
THESIS_FOCAL_LENGTHS_MM = (6, 8, 10, 11, 12, 13, 15, 19, 25, 29, 33, 39, 52)  # Table 11


def configure(parser: argparse.ArgumentParser) -> None:
    mask_arguments.add_mask(parser)
    mask_arguments.add_sensor(parser)
    mask_arguments.add_installation(parser)
    parser.add_argument(
        "--focal-length",
        type=float,
        nargs="+",
        metavar="MM",
        help="focal lengths of the lens (default: those of Table 11)",
    )
    parser.add_argument(
        "--rotation", type=float, default=0.0, metavar="DEGREES", help="rotation of the mask (default: 0)"
    )
    parser.add_argument(
        "--carriers", action="store_true", help="list every carrier with its row and column, including crossed ones"
    )
    parser.add_argument(
        "--visibility", action="store_true", help="predicted strength of each order on the sensor, and what takes it"
    )
    parser.add_argument(
        "--f-number", type=float, nargs="+", default=[8.0, 11.0, 16.0, 22.0, 32.0], metavar="N",
        help="stops for --visibility (default: 8 11 16 22 32)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    one = mask_arguments.installed(arguments)
    only = mask_arguments.only_length(one.camera)
    lengths = arguments.focal_length or (THESIS_FOCAL_LENGTHS_MM if only is None else (only,))
    rows = carrier_tables.table(one.mask, one.sensor, one.distance_mm, lengths, law=one.law)
    warnings = _beyond(one, lengths)
    if arguments.visibility:
        return _visibility(one, lengths, arguments.f_number, as_json=arguments.json)
    if arguments.carriers or arguments.rotation:
        return _carriers(one, lengths, math.radians(arguments.rotation), as_json=arguments.json)
    if arguments.json:
        listed = {
            "shape": list(one.sensor.shape),
            "law": one.law,
            "mask_distance_mm": one.distance_mm,
            "rows": [asdict(r) for r in rows],
            "warnings": warnings,
        }
        print(json.dumps(listed, indent=2))
        return 0
    names = "".join(f"  {'×' + str(m):>10} H {'V':>7}" for m in one.mask.multiples)
    high, wide = one.sensor.shape
    print(f"law {one.law}, mask {one.distance_mm:g} mm from {wide} × {high} px; bins from the centre, * off the sensor")
    print(f"{'f/mm':>6}{names}   slice")
    for row in rows:
        cells = "".join(
            f"  {h.horizontal_px:11.0f}{' ' if h.horizontal_on_sensor else '*'}"
            f"{h.vertical_px:7.0f}{' ' if h.vertical_on_sensor else '*'}"
            for h in row.harmonics
        )
        size = "none" if row.slice_px is None else f"{row.slice_px[1]} × {row.slice_px[0]}"
        print(f"{row.focal_length_mm:6g}{cells}  {size}")
    contrasts = ", ".join(f"×{h.multiple} {h.contrast:.2f}" for h in rows[0].harmonics)
    print(f"contrast left by diffraction at 550 nm: {contrasts}")
    for warning in warnings:
        print(f"warning: {warning}")
    return 0


def _beyond(one: Installed, lengths: Sequence[float]) -> list[str]:
    """The focal lengths at which the law asks the mask for more than it has; the sentence is the worst one's."""
    found = {}
    for length in sorted(lengths):
        lattice = carrier_tables.lattice_of(one.law, one.mask, one.sensor, one.distance_mm, length)
        sentence = carrier_tables.beyond_mask(one.mask, one.sensor, lattice)
        if sentence is not None:
            found[length] = sentence
    if not found:
        return []
    shortest, longest = min(found), max(found)
    at = f"at {shortest:g} mm" if len(found) == 1 else f"from {shortest:g} to {longest:g} mm; at {shortest:g} mm"
    return [f"{at} {found[shortest]}"]


def _carriers(one: Installed, lengths: Sequence[float], rotation_rad: float, *, as_json: bool) -> int:
    listed = []
    for length in lengths:
        lattice = carrier_tables.lattice_of(
            one.law, one.mask, one.sensor, one.distance_mm, length, rotation_rad=rotation_rad
        )
        for main, orders in ((True, one.mask.orders()), (False, carrier_tables.crossed_orders(one.mask))):
            for carrier in lattice.carriers(orders):
                row, column = carrier.index(one.sensor.shape)
                place = {"row": row, "col": column, "main": main, "on_sensor": carrier.on_sensor}
                listed.append({"focal_length_mm": length, "ky": carrier.ky, "kx": carrier.kx, **place})
    if as_json:
        print(json.dumps({"shape": list(one.sensor.shape), "law": one.law, "carriers": listed}, indent=2))
        return 0
    print(f"{'f/mm':>6} {'ky':>4} {'kx':>4} {'row':>9} {'col':>9}")
    for c in listed:
        words = f"{'' if c['main'] else '  crossed'}{'' if c['on_sensor'] else '  off the sensor'}"
        print(f"{c['focal_length_mm']:6g} {c['ky']:4d} {c['kx']:4d} {c['row']:9.1f} {c['col']:9.1f}{words}")
    return 0


def _visibility(one: Installed, lengths: Sequence[float], stops: Sequence[float], *, as_json: bool) -> int:
    """The strength of each order, as a share of the mean, at least and at most over the shapes that a stop may have."""
    listed = []
    for length in lengths:
        lattice = carrier_tables.lattice_of(one.law, one.mask, one.sensor, one.distance_mm, length)
        for stop in stops:
            within("f-number", stop, "", 0.5, 256)
            for order in order_strengths(
                one.mask, one.sensor, lattice, mask_distance_mm=one.distance_mm, f_number=stop
            ):
                listed.append({"focal_length_mm": length, "f_number": stop, **asdict(order), "cause": order.cause})
    if as_json:
        print(json.dumps({"shape": list(one.sensor.shape), "law": one.law, "orders": listed}, indent=2))
        return 0
    print(f"law {one.law}, mask {one.distance_mm:g} mm before the sensor; strengths as shares of the mean")
    print(f"{'f/mm':>6} {'f/':>5} {'ky':>4} {'kx':>4} {'least':>9} {'most':>9}")
    for row in listed:
        ky, kx = row["order"]
        start = f"{row['focal_length_mm']:6g} {row['f_number']:5g} {ky:4d} {kx:4d}"
        print(f"{start} {row['least']:9.5f} {row['most']:9.5f}  {row['cause'] or ''}".rstrip())
    return 0
