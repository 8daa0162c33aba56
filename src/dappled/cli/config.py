"""`dappled config check|show` and `dappled profiles`: check and show settings, list profiles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from dappled.cli.table import words_only
from dappled.cli.verb import Output, Report, Verb, argument
from dappled.config import settings

if not words_only:
    import tomli_w

    from dappled.config import profiles
    from dappled.daemon import settings_check


@dataclass(frozen=True, kw_only=True)
class CheckSettings(Verb):
    """Check a settings file."""

    examples = ("dappled config check /etc/dappled/dappled.toml",)

    file: Path = argument("FILE", "settings file")

    def run(self, output: Output) -> Report:
        settings_check.checked(settings.examine_file(self.file), by_this_user=False)
        return Report({"file": str(self.file), "good": True}, [f"{self.file}: good"])


@dataclass(frozen=True, kw_only=True)
class ShowSettings(Verb):
    """Show every setting with its value, unit and meaning."""

    examples = ("dappled config show > dappled.toml",)

    file: Path | None = argument("FILE", "settings file (default: the built-in settings)", default=None)

    def run(self, output: Output) -> Report:
        tables = settings.to_tables(settings.load(self.file))
        return Report(tables, list(_lines(tables)))


def _lines(tables: dict[str, dict[str, object]]) -> Iterator[str]:
    shown = None
    for table, key, _, rule in settings.describe():
        if table != shown:
            yield from ([] if shown is None else [""])
            yield f"[{table}]"
            shown = table
        unit = f" [{rule.unit}]" if rule.unit else ""
        choices = f" ({', '.join(c or chr(34) * 2 for c in rule.choices)})" if rule.choices else ""
        if key in tables[table]:
            line = tomli_w.dumps({key: tables[table][key]}, multiline_strings=False).strip().replace("\n", " ")
        else:
            line = f"# {key} is not set"
        yield f"{line:42} # {rule.text}{unit}{choices}"


@dataclass(frozen=True, kw_only=True)
class ListProfiles(Verb):
    """List the shipped profiles."""

    examples = ("dappled profiles",)

    def run(self, output: Output) -> Report:
        cameras = [profiles.camera(name) for name in profiles.shipped("cameras")]
        masks = [profiles.mask(name) for name in profiles.shipped("masks")]
        values = {
            "cameras": [
                {
                    "name": c.name,
                    "law": c.law,
                    "description": c.description,
                    "raw": [{"name": raw.name, "shape": list(raw.sensor.shape)} for raw in c.raw],
                }
                for c in cameras
            ],
            "masks": [{"name": m.name, "carriers": len(m.mask.orders()), "description": m.description} for m in masks],
        }
        lines = []
        for camera in cameras:
            lines.append(f"camera {camera.name:16} {camera.law:10} {camera.description}")
            for raw in camera.raw:
                height, width = raw.sensor.shape
                lines.append(f"{'':34} {height} × {width} px: {raw.name}")
        lines += [f"mask   {m.name:16} {len(m.mask.orders()):3} carriers {m.description}" for m in masks]
        return Report(values, lines)
