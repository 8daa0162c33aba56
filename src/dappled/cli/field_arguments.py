"""Arguments of verbs that read a decoded light field, and opening it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dappled.cli import paths
from dappled.cli.table import words_only
from dappled.cli.verb import Doubtable, argument, option
from dappled.findings import Finding, Subject, of_subject, text

if not words_only:
    from dappled.decode.depth import RANGING, Ranging
    from dappled.decode.lightfield import LightField
    from dappled.drivers.raw import calibration_files
    from dappled.products import opened
    from dappled.products.opened import OpenedLightField

FIELD_HELP = "decoded light field (.zarr, .npz, .h5), or a folder of n × n pictures"


@dataclass(frozen=True, kw_only=True)
class FieldArguments(Doubtable):
    """The light field."""

    field: Path = argument("LIGHTFIELD", FIELD_HELP, there=paths.light_field)


@dataclass(frozen=True, kw_only=True)
class RangingArguments:
    """What gives distances in metres."""

    focus: float | None = option(
        "--focus", "distance at which the lens was focused, or inf", None, unit="m", above=0.0,
        infinite=True,
    )  # fmt: skip
    calibration: Path | None = option(
        "--calibration", "calibration with targets, from dappled calibrate --target", None, there=True,
    )  # fmt: skip


def opened_field(path: Path, ranging: RangingArguments | None = None) -> OpenedLightField:
    """The light field of a path, with the distances that the arguments give. Raises DappledError."""
    found = opened.light_field(path, focus_m=None if ranging is None else ranging.focus)
    if ranging is not None and ranging.calibration is not None:
        tables = calibration_files.tables(ranging.calibration)
        if RANGING not in tables:
            raise opened.OpenError(
                f"{ranging.calibration} has no distances: make it again with dappled calibrate --target"
            )
        found = OpenedLightField(opened.with_ranging(found.field, Ranging.from_dict(tables[RANGING])), found.path)
        found.metres()  # the user named it: refuse it if it is for another focal length
    return found


def doubts(found: OpenedLightField) -> list[Finding]:
    """What is in doubt about a light field: whatever is made of it is in doubt for that."""
    return of_subject(found.doubts, Subject("light field", str(found.path)))


def views_words(field: LightField) -> str:
    """How the views of a light field were made, where that was not by the model of the light field; else ""."""
    if field.attributes.get("views_model") != "independent":
        return ""
    reason = field.views_reason
    return f"views of each spatial frequency by itself{f': {text(reason)}' if reason else ''}"
