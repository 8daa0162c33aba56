"""Write the quality of a flight on a page: counts, ground resolution, coverage, overlap, blur, poses, doubts."""

from __future__ import annotations

import base64
import html
import io
import tempfile
import textwrap
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dappled import durable
from dappled.errors import DappledError, counted
from dappled.findings import Finding, Level, above_note, in_order, told
from dappled.flight import flight_report
from dappled.flight.flight_report import Balance
from dappled.products.extras import need
from dappled.products.maps import coverage, coverage_files
from dappled.products.maps.coverage import FramesSeen
from dappled.products.maps.eye import Eye

_GRID = 24  # points along each side of a frame by which overlap is measured
_WIDE, _LINES = 96, 62  # characters and lines of a page of the PDF
_STYLE = """:root { color-scheme: light dark }
body { font: 16px/1.45 system-ui, sans-serif; max-width: 46rem; margin: 0 auto; padding: 12px }
h1 { font-size: 1.3rem; overflow-wrap: anywhere } h2 { font-size: 1.05rem; margin: 1.4em 0 .3em }
table { border-collapse: collapse; width: 100% } td { padding: 4px 0; border-top: 1px solid #8884; vertical-align: top }
td:last-child { text-align: right; font-weight: 600; padding-left: 12px } img { width: 100%; height: auto }
li { margin: .4em 0; overflow-wrap: anywhere } .verdict { padding: 10px 14px; border-radius: 6px; color: #fff }
.good { background: #0a6b35 } .doubt { background: #8a4b00 }"""


class QualityPart(NamedTuple):
    """What is said of one thing: names and values."""

    title: str
    values: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class FlightQuality:
    """A flight's quality; `picture` is a PNG of how many frames saw the ground, None where nobody knows."""

    flight: str
    counts: str  # whether they agree
    agrees: bool
    parts: tuple[QualityPart, ...]
    doubts: tuple[Finding, ...]
    notes: tuple[Finding, ...]
    picture: bytes | None


def of_flight(flight: Path) -> FlightQuality:
    """Judge a recorded flight, by its ledger alone: nothing is decoded. Raises FlightError."""
    found, contents = flight_report.balance(flight), flight_report.show(flight)
    tags = [line.tag for line in contents.lines if line.tag is not None]
    said: list[Finding] = [*found.doubts, *filter(None, [found.cut_short]), *found.bad, *found.unknown, *found.card]
    said += [*found.lost_triggers, *(one.finding for one in found.stood)]
    said += [one for tag in tags for one in tag.doubts]
    parts, picture = [_counts(found)], None
    try:
        seen = coverage.of_flight(flight)
        ground, picture = _ground(seen)
        parts.append(ground)
        said += seen.left
    except DappledError as error:
        parts.append(QualityPart("Ground", (("not known", str(error)),)))
    verdicts = [line.result.verdict for line in contents.lines if line.result and line.result.verdict]
    blur = [px for one in verdicts if (px := one.facts.get("blur_view_px")) is not None]
    if found.mask:
        frames = counted(found.mask.number("frames"), "frame")
        parts.append(QualityPart("Mask", (("seen in", f"{found.mask.number('seen')} of {frames}"),)))
    judged = tuple((f"judged {state}", str(count)) for state, count in found.judged.items())
    parts.append(QualityPart("Sharpness", (*judged, ("motion blur", _spread(blur, "view pixels")))))
    sigmas = [sigma for tag in tags if (sigma := tag.pose.position_sigma_m) is not None]
    sources = Counter(tag.pose.source for tag in tags)
    placed = tuple((f"position {source}", counted(count, "frame")) for source, count in sources.most_common())
    parts.append(QualityPart("Poses", (*placed, ("standard deviation of position", _spread(sigmas, "m")))))
    agrees = found.balanced and found.wishes > 0
    counts = "no shot was taken" if found.balanced else "the counts do not agree"
    notes = [one for one in said if one.level <= Level.NOTE]
    return FlightQuality(
        found.flight,
        "the counts agree" if agrees else counts,
        agrees,
        tuple(parts),
        tuple(in_order(above_note(said))),
        tuple(in_order(notes)),
        picture,
    )


def _verdict(made: FlightQuality) -> str:
    doubts = counted(len(_told(made.doubts)), "doubt") if made.doubts else "nothing is in doubt"
    return f"{made.counts}; {doubts}"


def _told(found: Sequence[Finding]) -> list[str]:
    """What was found, each once."""
    return list(dict.fromkeys(str(told(one)) for one in found))


def _lists(made: FlightQuality) -> list[tuple[str, list[str]]]:
    return [(title, _told(found)) for title, found in (("Doubts", made.doubts), ("Notes", made.notes)) if found]


def _counts(found: Balance) -> QualityPart:
    """The three books: requests, the ledger, and the files."""
    values = (
        ("requests", f"{found.wishes + found.refused}, of them {found.refused} refused"),
        ("shots in the ledger", f"{found.wishes}: {found.safe} safe, {found.failed} failed, {found.open} open"),
        (
            "files of frames",
            f"{found.frames}, {found.size / 1e6:.1f} MB; {counted(found.strays, 'file')} without a shot",
        ),
        ("triggers of the autopilot that became no shot", str(found.lost)),
        ("with a position and time", str(found.tagged)),
        ("decoded in flight", str(found.decoded)),
    )
    return QualityPart("Counts", values)


def _ground(seen: FramesSeen) -> tuple[QualityPart, bytes]:
    """Ground resolution, overlap and coverage, and the picture of coverage."""
    eyes = [*seen.eyes.values()]
    levels = [float(seen.ground.heights(eye.centre[:1], eye.centre[1:2])[0]) for eye in eyes]
    cm = [100 * eye.gsd_m(level) for eye, level in zip(eyes, levels, strict=True) if np.isfinite(level)]
    shares = [100 * _shared(a, b, level) for (a, b), level in zip(pairwise(eyes), levels, strict=False)]
    covered = coverage.cover(seen, coverage.grid_of(seen, None))
    often = [f"{covered.cell_m2 * int((covered.frames >= least).sum()):.0f} m²" for least in (1, 2, 3)]
    values = (
        ("frames on the ground", f"{len(eyes)}, on {seen.ground.name}"),
        ("ground of a sensor's pixel", _spread(cm, "cm")),
        ("overlap with the next frame", _spread(shares, "%", worst=min)),
        *((f"seen by {counted(n, 'frame')} or more", area) for n, area in zip((1, 2, 3), often, strict=True)),
    )
    with tempfile.TemporaryDirectory(prefix="dappled-page-") as folder:
        path = Path(folder) / "coverage.png"
        coverage_files.write_picture(covered, seen.projection, None, path, least=1)
        return QualityPart("Ground", values), path.read_bytes()


def _shared(eye: Eye, following: Eye, level_m: float) -> float:
    """The share of what a frame shows of a plane that the next one shows, too."""
    rows, columns = eye.shape
    across, down = np.meshgrid(np.linspace(0, columns - 1, _GRID), np.linspace(0, rows - 1, _GRID))
    pixels = np.stack([across.ravel(), down.ravel()], axis=1)
    places = np.column_stack([eye.on_plane(pixels, level_m), np.full(len(pixels), level_m)])
    return float(following.shows(places).mean())


def _spread(values: Sequence[float], unit: str, *, worst: Callable[[Sequence[float]], float] = max) -> str:
    """The middle one and the worst one."""
    known = [value for value in values if np.isfinite(value)]
    return f"{float(np.median(known)):.3g} {unit}, at worst {worst(known):.3g}" if known else "unknown"


def write(made: FlightQuality, path: Path) -> None:
    """Write the page as its name says: .html or .pdf (with matplotlib). Raises MissingExtraError, OSError."""
    page = _pdf(made) if path.suffix == ".pdf" else _html(made).encode()
    durable.write_file(path.absolute(), page)


def _html(made: FlightQuality) -> str:
    text = html.escape
    parts = "".join(
        f"<h2>{text(part.title)}</h2><table>"
        + "".join(f"<tr><td>{text(name)}</td><td>{text(value)}</td></tr>" for name, value in part.values)
        + "</table>"
        for part in made.parts
    )
    drawn = ""
    if made.picture is not None:
        data = base64.b64encode(made.picture).decode()
        drawn = f'<h2>Coverage</h2><img alt="how many frames saw the ground" src="data:image/png;base64,{data}">'
    listed = "".join(
        f"<h2>{title}</h2><ul>{''.join(f'<li>{text(one)}</li>' for one in said)}</ul>" for title, said in _lists(made)
    )
    state = "good" if made.agrees and not made.doubts else "doubt"
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{text(made.flight)}</title><style>{_STYLE}</style><h1>{text(made.flight)}</h1>"
        f'<p class="verdict {state}">{text(_verdict(made))}</p>{parts}{drawn}{listed}</html>\n'
    )


def _pdf(made: FlightQuality) -> bytes:
    figures, pages = need("matplotlib.figure"), need("matplotlib.backends.backend_pdf")
    lines = [made.flight, _verdict(made)]
    for part in made.parts:
        lines += ["", part.title.upper(), *(f"{name}: {value}" for name, value in part.values)]
    for title, said in _lists(made):
        lines += ["", title.upper(), *said]
    lines = [piece for line in lines for piece in textwrap.wrap(line, _WIDE, subsequent_indent="    ") or [""]]
    file = io.BytesIO()
    with pages.PdfPages(file) as pdf:
        for first in range(0, len(lines), _LINES):
            page = figures.Figure(figsize=(8.27, 11.69))  # A4
            page.text(0.08, 0.95, "\n".join(lines[first : first + _LINES]), va="top", size=9, parse_math=False)
            pdf.savefig(page)
        if made.picture is not None:
            page = figures.Figure(figsize=(8.27, 11.69))
            axes = page.add_axes((0.08, 0.08, 0.84, 0.84))
            axes.imshow(need("PIL.Image").open(io.BytesIO(made.picture)))
            axes.set_axis_off()
            pdf.savefig(page)
    return file.getvalue()
