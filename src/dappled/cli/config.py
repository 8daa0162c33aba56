"""`dappled config check|show` and `dappled profiles`: check and show settings, list profiles."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import tomli_w

from dappled.cli.arguments import Actions
from dappled.config import profiles, settings
from dappled.daemon import settings_check


def configure(parser: argparse.ArgumentParser) -> None:
    if parser.prog.endswith("profiles"):
        parser.add_argument("--json", action="store_true", help="print JSON")
        parser.epilog = "example: dappled profiles"
        parser.set_defaults(action="profiles")
        return
    parser.epilog = "example: dappled config check /etc/dappled/dappled.toml"
    actions = Actions.of(parser)
    check = actions.add("check", "check a settings file", "dappled config check /etc/dappled/dappled.toml")
    check.add_argument("file", type=Path, metavar="FILE", help="settings file")
    check.add_argument("--json", action="store_true", help="print JSON")
    show = actions.add(
        "show", "show every setting with its value, unit and meaning", "dappled config show > dappled.toml"
    )
    show.add_argument(
        "file", type=Path, nargs="?", metavar="FILE", help="settings file (default: the built-in settings)"
    )
    show.add_argument("--json", action="store_true", help="print JSON")


def run(arguments: argparse.Namespace) -> int:
    if arguments.action == "profiles":
        return _profiles(arguments.json)
    if arguments.action == "check":
        settings_check.checked(settings.examine_file(arguments.file), by_this_user=False)
        print(json.dumps({"file": str(arguments.file), "good": True}) if arguments.json else f"{arguments.file}: good")
        return 0
    loaded = settings.load(arguments.file)
    if arguments.json:
        print(json.dumps(settings.to_tables(loaded), indent=2))
    else:
        _show(settings.to_tables(loaded))
    return 0


def _show(tables: dict[str, dict[str, object]]) -> None:
    shown = None
    for table, key, _, rule in settings.describe():
        if table != shown:
            print(f"{'' if shown is None else chr(10)}[{table}]")
            shown = table
        unit = f" [{rule.unit}]" if rule.unit else ""
        choices = f" ({', '.join(c or chr(34) * 2 for c in rule.choices)})" if rule.choices else ""
        if key in tables[table]:
            line = tomli_w.dumps({key: tables[table][key]}, multiline_strings=False).strip().replace("\n", " ")
        else:
            line = f"# {key} is not set"
        print(f"{line:42} # {rule.text}{unit}{choices}")


def _profiles(as_json: bool) -> int:
    cameras = [profiles.camera(name) for name in profiles.shipped("cameras")]
    masks = [profiles.mask(name) for name in profiles.shipped("masks")]
    if as_json:
        found = {
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
        print(json.dumps(found, indent=2))
        return 0
    for camera in cameras:
        print(f"camera {camera.name:16} {camera.law:10} {camera.description}")
        for raw in camera.raw:
            height, width = raw.sensor.shape
            print(f"{'':34} {height} × {width} px: {raw.name}")
    for mask in masks:
        print(f"mask   {mask.name:16} {len(mask.mask.orders()):3} carriers {mask.description}")
    return 0
