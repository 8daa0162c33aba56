"""`dappled carriers`: predict the carriers, measure them in a frame, print a table, draw the spectrum."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from dappled import codec
from dappled.cli import paths
from dappled.cli.frame_arguments import FRAME_HELP, RecipeArguments
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, Output, Overwriting, Report, Verb, argument, flag, option
from dappled.errors import CallError, DappledError, counted
from dappled.findings import FRAME, Finding, told

if not words_only:
    from dappled.config import profiles
    from dappled.decode.calibration.law_search import LawSearch
    from dappled.decode.decoder import CarriersFrom
    from dappled.decode.optics import Carrier, Lattice, Mask, Order
    from dappled.decode.optics.carrier_tables import crossed_orders, lattice_rotation
    from dappled.decode.spectrum import Plane
    from dappled.decode.spectrum.lattice import FoundLattice, find_lattice
    from dappled.decode.spectrum.peaks import Measured, displaced, measure
    from dappled.decode.spectrum.pictures import Look, around, spectrum_boxes
    from dappled.decode.spectrum.transform import padded_shape, transform
    from dappled.drivers.raw import recipe_check
    from dappled.drivers.raw.darkroom import Darkroom, known_to, naming
    from dappled.drivers.raw.law_check import FrameLens, LawCheck, check
    from dappled.products.exports import prints


@dataclass(frozen=True, slots=True)
class Table:
    """What is printed: the carriers of both half planes, predicted and measured."""

    shape: tuple[int, int]
    law: str
    focal_length_mm: float | None
    lattice: Lattice
    rows: Sequence[tuple[Carrier, Measured | None]]
    main: frozenset[Order]
    found: FoundLattice | None = None
    carriers_from: CarriersFrom | None = None
    own: Lattice | None = None
    rotation_rad: float | None = None
    checked: LawCheck | None = None
    off: Finding | None = None

    @property
    def search(self) -> LawSearch | None:
        """What the frame shows under all laws, where they were tried."""
        return None if self.checked is None else self.checked.search

    @property
    def doubt(self) -> Finding | None:
        """Why the carriers can't be where slices are cut, or what can't be told of them; None where nothing is."""
        return None if self.checked is None else self.checked.contradiction or self.checked.unsettled

    @property
    def used(self) -> Lattice:
        """The lattice that slices are cut at: the frame's own if it shows one, else the predicted."""
        return self.own or self.lattice

    @property
    def seen(self) -> int:
        """How many carriers the frame shows, without the mean and suspect ones."""
        return sum(m is not None and not m.suspect and (c.ky, c.kx) != (0, 0) for c, m in self.rows)


@dataclass(frozen=True, kw_only=True)
class ShowCarriers(Overwriting, Doubtable, RecipeArguments, Verb):
    """Show the predicted and the measured carriers."""

    examples = (
        "dappled carriers frame.dng --mask reference-5x5 --picture spectrum.png",
        "dappled carriers --shape 2776 3688 --camera fujifilm-s5200 --mask mask-2 --focal-length 13",
        "dappled carriers lytro.png --mask lenslet",
    )

    frame: Path | None = argument("FRAME", FRAME_HELP, default=None, there=paths.file)
    mask: str = option("--mask", "mask profile or TOML file, or lenslet")
    crossed: bool = flag(
        "--crossed", "also list the orders between harmonics, which the pattern is not designed to make"
    )
    shape: tuple[int, int] | None = option(
        "--shape", "only predict, for frames of this size", None, metavar=("H", "W"), low=1,
    )  # fmt: skip
    picture: Path | None = option("--picture", "draw the spectrum with its boxes", None, metavar="FILE.png")
    look: Literal["magnitude", "phase", "laplacian"] | None = option(
        "--look", "what the picture shows", None, choices=("magnitude", "phase", "laplacian"),
        otherwise="magnitude; with --around: phase",
    )  # fmt: skip
    around: tuple[int, int] | None = option(
        "--around", "draw the bins around this carrier, each as a square", None, metavar=("KY", "KX"),
    )  # fmt: skip

    def check(self) -> None:
        self.refuse_existing(self.picture)
        if self.frame is None:
            if not self.shape or self.camera == "auto" or self.mask == profiles.LENSLET:
                raise CallError("name a frame, or give --shape, --camera, --mask and --focal-length to predict")
            if self.focal_length is None:
                raise CallError("without a frame the focal length is unknown: give --focal-length, in mm")
            if self.picture:
                raise CallError("--picture draws a frame's spectrum: name the frame")
        recipe_check.check(self.recipe())

    def run(self, output: Output) -> Report:
        if self.frame is None:
            table = self._predicted()
        else:
            plane, table = self._measured(self.frame)
            if self.picture:
                prints.save(self.picture, self._picture(plane, table))
        return Report(_as_json(table), _lines(table), findings=[table.doubt] if table.doubt else ())

    def _picture(self, plane: Plane, table: Table) -> Any:
        if self.around is None:
            return picture(plane, table, self.look or "magnitude")
        (carrier,) = table.used.carriers([self.around])
        if not carrier.on_sensor:
            raise DappledError(
                f"the carrier {carrier.ky} {carrier.kx} falls off the sensor: choose another one with --around"
            )
        return around(plane, (carrier.fy, carrier.fx), look=self.look or "phase")

    def _predicted(self) -> Table:
        assert self.shape is not None
        assert self.focal_length is not None
        camera = profiles.camera(self.camera)
        darkroom = Darkroom(self.recipe())
        decoder = darkroom.mask_decoder(self.shape, next(iter(camera.models), ""))
        mask = decoder.optics.mask
        lattice = decoder.lattice_at(self.focal_length)
        orders = sorted([*mask.orders(), *(crossed_orders(mask) if self.crossed else [])])
        rows = [(carrier, None) for carrier in lattice.carriers(orders)]
        return Table(decoder.optics.sensor.shape, decoder.optics.law, self.focal_length, lattice, rows, _main(mask))

    def _measured(self, frame: Path) -> tuple[Plane, Table]:
        darkroom = Darkroom(self.recipe())
        raw = darkroom.read(frame)
        with naming(frame):
            plane = darkroom.plane(raw)
            shape = (plane.shape[0], plane.shape[1])
            if self.mask == profiles.LENSLET:
                found = find_lattice(transform(plane, workers=2))
                pairs = list(zip(found.carriers, found.measured, strict=True))
                mean = Measured(0.0, 0.0, 1.0, 0.0, 1.0, False)  # which every frame has
                rows = _both_halves([(Carrier(0, 0, 0.0, 0.0), mean), *pairs])
                main = frozenset(found.orders) | {(0, 0)}
                return plane, Table(
                    shape, "found", None, found.lattice, rows, main, found, "found", None, found.rotation_rad
                )
            decoder = known_to(
                darkroom.mask_decoder(shape, raw.model or ""), None if self.focal_length else raw.focal_sigma_mm
            )
            length = self.focal_length or raw.focal_length_mm
            if length is None:
                raise DappledError(f"{frame} doesn't say its focal length: give --focal-length MM")
            spectrum = transform(plane, workers=2)
            predicted = decoder.predict(length)
            used, seen, carriers_from = decoder.locate(spectrum, length, predicted)
            stop = self.f_number or raw.f_number
            stops = darkroom.camera(raw.model or "").f_numbers
            lens = FrameLens(length, stop, None if stops is None else stops[1])
            checked = check(
                decoder,
                plane,
                lens,
                used,
                list(zip(predicted, seen, strict=True)),
                carriers_from=carriers_from,
                keep_law=bool(self.law),
            )
            if checked.decoder is not decoder:
                decoder = checked.decoder
                predicted = decoder.predict(length)
                used, seen, carriers_from = decoder.locate(spectrum, length, predicted)
            change = decoder.change(spectrum, length, predicted, seen) if carriers_from == "measured" else None
            known = {(c.ky, c.kx): m for c, m in zip(predicted, seen, strict=True)}
            lattice = decoder.lattice_at(length)
            mask = decoder.optics.mask
            halves = lattice.carriers(mask.half_orders())
            if self.crossed:
                between = [order for order in crossed_orders(mask) if order > (0, 0)]
                halves += lattice.carriers(between)
                near = measure(spectrum, used.carriers(between), 2.0)
                known |= dict(zip(between, near, strict=True))
            rows = _both_halves([(c, known.get((c.ky, c.kx))) for c in halves])
            turned = lattice_rotation(used, decoder.optics.sensor)
            return plane, Table(
                shape,
                decoder.optics.law,
                length,
                lattice,
                rows,
                _main(mask),
                carriers_from=carriers_from,
                own=used,
                rotation_rad=turned,
                checked=checked,
                off=None if change is None else change.finding,
            )


def picture(plane: Plane, table: Table, look: Look = "magnitude") -> Any:
    """The spectrum with a box around each slice, uint8 RGB (Figs 36, 41, 42)."""
    half = [(c, m) for c, m in table.rows if (c.ky, c.kx) >= (0, 0) and c.on_sensor]
    high, wide = padded_shape(table.shape)
    size = table.used.slice_size((high, wide))
    return spectrum_boxes(
        plane,
        table.used.carriers([(c.ky, c.kx) for c, _ in half]),
        (size[0] / high, size[1] / wide),
        predicted=[c for c, _ in half],
        measured=[m for _, m in half],
        look=look,
    )


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
            **codec.plain(carrier),
            "row": row,
            "col": column,
            "main": (carrier.ky, carrier.kx) in table.main or (-carrier.ky, -carrier.kx) in table.main,
            "on_sensor": carrier.on_sensor,
            "measured": None,
        }
        if seen is not None:
            at = Carrier(carrier.ky, carrier.kx, seen.fy, seen.fx).index(table.shape)
            entry["measured"] = {**codec.plain(seen), "row": at[0], "col": at[1]}
        carriers.append(entry)
    whole: dict[str, Any] = {
        "shape": list(table.shape),
        "law": table.law,
        "focal_length_mm": table.focal_length_mm,
        "carriers": carriers,
    }
    if table.carriers_from is not None:
        whole["carriers_from"] = table.carriers_from
        whole["rotation_rad"] = table.rotation_rad
    if table.search is not None:
        whole["observable"] = table.search.found is not None or table.search.expected
        whole["reason"] = codec.plain(table.doubt or table.search.unseen)
        whole["laws"] = [{"law": one.law, "odds_nats": one.nats} for one in table.search.odds]
    if table.found:
        whole["pitch_px"] = list(table.found.spacing_px)
    return whole


def _lines(table: Table) -> list[str]:
    lines = [f"{'ky':>3} {'kx':>3} {'row':>9} {'col':>9}   {'seen row':>9} {'seen col':>9} {'strength':>8}"]
    for carrier, seen in table.rows:
        row, column = carrier.index(table.shape)
        line = f"{carrier.ky:3d} {carrier.kx:3d} {row:9.2f} {column:9.2f}"
        if (carrier.ky, carrier.kx) not in table.main:
            line += " x"
        if not carrier.on_sensor:
            line += "   off the sensor"
        elif seen is not None:
            at = Carrier(0, 0, seen.fy, seen.fx).index(table.shape)
            line += f"   {at[0]:9.2f} {at[1]:9.2f} {seen.strength:8.4f}"
            line += "  suspect: at a simple fraction of the frame, as sensor artefacts are" if seen.suspect else ""
        lines.append(line)
    if any((c.ky, c.kx) not in table.main for c, _ in table.rows):
        lines.append("x: a crossed order, between the two diagonals of harmonics")
    lines.append(_summary(table))
    return lines


def _summary(table: Table) -> str:
    """The result in a sentence."""
    if table.found:
        pitch = " × ".join(f"{p:.2f}" for p in table.found.spacing_px)
        return (
            f"a lattice of {pitch} px, turned by {math.degrees(table.found.rotation_rad):.2f}°, "
            f"residual {table.found.residual_bins:.2f} bins; {counted(table.seen, 'carrier')}"
        )
    start = f"law {table.law}, focal length {table.focal_length_mm:g} mm"
    if table.carriers_from is None:
        return f"{start}; predicted only"
    there = sum(c.on_sensor for c, _ in table.rows) - 1
    if table.carriers_from == "measured" and table.rotation_rad is not None:
        turned = math.degrees(table.rotation_rad)
        sentence = f"{start}; {table.seen} of {there} carriers seen, on a lattice turned by {turned:.3f}°"
        orders = [(c.ky, c.kx) for c, _ in table.rows]
        if table.search is not None:
            sentence += f"; {table.search.sentence}"
        if table.off is not None:
            sentence += f"; {told(table.off, FRAME)}"
        strange = table.doubt or displaced(table.used.carriers(orders), [c for c, _ in table.rows])
        return f"{sentence}; {told(strange, FRAME)}" if strange else sentence
    whose = "calibration's" if table.carriers_from == "calibrated" else "law's"
    if table.search is not None and table.search.unseen is not None:
        return f"{start}; {told(table.search.unseen, FRAME)}; a decode uses the {whose} prediction"
    if table.seen == 0:
        return (
            f"{start}; no carriers in this frame: it was taken without this mask, or near the mask's ideal "
            f"aperture, where flat areas show none; a decode uses the {whose} prediction"
        )
    return f"{start}; {table.seen} of {there} carriers seen, too few or weak: a decode uses the {whose} prediction"
