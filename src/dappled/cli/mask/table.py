"""`dappled mask table`: print where the carriers are over focal lengths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from dappled import codec
from dappled.cli.mask.arguments import InstallationArguments, only_length
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, Verb, flag, option

if not words_only:
    from dappled.decode.optics import MaskedOptics, carrier_tables
    from dappled.decode.optics.visibility import order_strengths

THESIS_FOCAL_LENGTHS_MM = (6, 8, 10, 11, 12, 13, 15, 19, 25, 29, 33, 39, 52)  # Table 11


@dataclass(frozen=True, kw_only=True)
class TabulateCarriers(InstallationArguments, Verb):
    """Print where the carriers are."""

    examples = ("dappled mask table --mask mask-2 --camera fujifilm-s5200",)

    mask: str = option("--mask", "mask profile or TOML file")
    focal_length: tuple[float, ...] = option(
        "--focal-length", "focal lengths of the lens", (), unit="mm", otherwise="those of Table 11",
    )  # fmt: skip
    rotation: float = option("--rotation", "rotation of the mask", 0.0, metavar="DEGREES")
    carriers: bool = flag("--carriers", "list every carrier with its row and column, including crossed ones")
    visibility: bool = flag("--visibility", "predicted strength of each order on the sensor, and what takes it")
    f_number: tuple[float, ...] = option(
        "--f-number", "stops for --visibility", (8.0, 11.0, 16.0, 22.0, 32.0), low=0.5, high=256,
    )  # fmt: skip

    def check(self) -> None:
        self.installed(self.mask)

    def run(self, output: Output) -> Report:
        camera, one = self.installed(self.mask)
        only = only_length(camera)
        lengths = self.focal_length or (THESIS_FOCAL_LENGTHS_MM if only is None else (only,))
        rows = carrier_tables.table(one, lengths)
        if self.visibility:
            return _visibility(one, lengths, self.f_number)
        if self.carriers or self.rotation:
            return _carriers(one, lengths, math.radians(self.rotation))
        warnings = _beyond(one, lengths)
        high, wide = one.sensor.shape
        names = "".join(f"  {'×' + str(m):>10} H {'V':>7}" for m in one.mask.multiples)
        place = f"mask {one.distance_mm:g} mm from {wide} × {high} px"
        lines = [f"law {one.law}, {place}; bins from the centre, * off the sensor", f"{'f/mm':>6}{names}   slice"]
        for row in rows:
            cells = "".join(
                f"  {h.horizontal_px:11.0f}{' ' if h.horizontal_on_sensor else '*'}"
                f"{h.vertical_px:7.0f}{' ' if h.vertical_on_sensor else '*'}"
                for h in row.harmonics
            )
            size = "none" if row.slice_px is None else f"{row.slice_px[1]} × {row.slice_px[0]}"
            lines.append(f"{row.focal_length_mm:6g}{cells}  {size}")
        contrasts = ", ".join(f"×{h.multiple} {h.contrast:.2f}" for h in rows[0].harmonics)
        lines.append(f"contrast left by diffraction at 550 nm: {contrasts}")
        lines += [f"warning: {warning}" for warning in warnings]
        facts = {**_facts(one), "mask_distance_mm": one.distance_mm}
        return Report({**facts, "rows": codec.plain(rows), "warnings": warnings}, lines)


def _facts(one: MaskedOptics) -> dict[str, Any]:
    return {"shape": list(one.sensor.shape), "law": one.law}


def _beyond(one: MaskedOptics, lengths: Sequence[float]) -> list[str]:
    """The focal lengths at which the law asks the mask for more than it has; the sentence is the worst one's."""
    found = {}
    for length in sorted(lengths):
        lattice = carrier_tables.lattice_of(one, length)
        sentence = carrier_tables.beyond_mask(one.mask, one.sensor, lattice)
        if sentence is not None:
            found[length] = sentence
    if not found:
        return []
    shortest, longest = min(found), max(found)
    at = f"at {shortest:g} mm" if len(found) == 1 else f"from {shortest:g} to {longest:g} mm; at {shortest:g} mm"
    return [f"{at} {found[shortest]}"]


def _carriers(one: MaskedOptics, lengths: Sequence[float], rotation_rad: float) -> Report:
    listed = []
    for length in lengths:
        lattice = carrier_tables.lattice_of(one, length, rotation_rad=rotation_rad)
        for main, orders in ((True, one.mask.orders()), (False, carrier_tables.crossed_orders(one.mask))):
            for carrier in lattice.carriers(orders):
                row, column = carrier.index(one.sensor.shape)
                place = {"row": row, "col": column, "main": main, "on_sensor": carrier.on_sensor}
                listed.append({"focal_length_mm": length, "ky": carrier.ky, "kx": carrier.kx, **place})
    lines = [f"{'f/mm':>6} {'ky':>4} {'kx':>4} {'row':>9} {'col':>9}"]
    for c in listed:
        words = f"{'' if c['main'] else '  crossed'}{'' if c['on_sensor'] else '  off the sensor'}"
        lines.append(f"{c['focal_length_mm']:6g} {c['ky']:4d} {c['kx']:4d} {c['row']:9.1f} {c['col']:9.1f}{words}")
    return Report({**_facts(one), "carriers": listed}, lines)


def _visibility(one: MaskedOptics, lengths: Sequence[float], stops: Sequence[float]) -> Report:
    """The strength of each order, as a share of the mean, at least and at most over the shapes that a stop may have."""
    listed = []
    for length in lengths:
        lattice = carrier_tables.lattice_of(one, length)
        for stop in stops:
            for order in order_strengths(one, lattice, stop):
                listed.append({"focal_length_mm": length, "f_number": stop, **codec.plain(order), "cause": order.cause})
    lines = [
        f"law {one.law}, mask {one.distance_mm:g} mm before the sensor; strengths as shares of the mean",
        f"{'f/mm':>6} {'f/':>5} {'ky':>4} {'kx':>4} {'least':>9} {'most':>9}",
    ]
    for row in listed:
        ky, kx = row["order"]
        start = f"{row['focal_length_mm']:6g} {row['f_number']:5g} {ky:4d} {kx:4d}"
        lines.append(f"{start} {row['least']:9.5f} {row['most']:9.5f}  {row['cause'] or ''}".rstrip())
    return Report({**_facts(one), "orders": listed}, lines)
