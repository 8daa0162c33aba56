"""The page's own promises: readable in sunlight, and nothing from elsewhere."""

from __future__ import annotations

import re
from importlib import resources

import pytest

STATIC = resources.files("dappled.daemon.console") / "static"
TEXTS = ("ink", "soft", "go", "caution", "no-go", "link")


def text(name: str) -> str:
    return (STATIC / name).read_text(encoding="utf-8")


def schemes() -> list[dict[str, str]]:
    """The colours of the light scheme, and those of the dark one on top of it."""
    found = re.findall(r":root \{(.*?)\}", text("console.css"), re.DOTALL)
    light, dark = (dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", block)) for block in found)
    return [light, light | dark]


def contrast(one: str, other: str) -> float:
    """WCAG 2's contrast ratio of two colours."""

    def luminance(colour: str) -> float:
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("scheme", [0, 1])
def test_every_text_stands_out_from_its_ground(scheme: int) -> None:
    colours = schemes()[scheme]
    for name in TEXTS:
        assert contrast(colours[name], colours["paper"]) >= 6, name
    assert contrast(colours["stage-ink"], colours["stage"]) >= 12
    assert contrast(colours["stage-soft"], colours["stage"]) >= 7
    assert contrast(colours["field"], colours["raised"]) >= 3  # the border of what can be filled in


@pytest.mark.parametrize(
    "name", ["index.html", "main.js", "settings.js", "stage.js", "refocus.js", "map.js", "format.js", "console.css"]
)
def test_nothing_comes_from_elsewhere(name: str) -> None:
    addresses = re.findall(r"(?:https?:)?//[a-z0-9.-]+\.[a-z]{2,}[^\s\"']*", text(name))
    assert [one for one in addresses if "www.w3.org" not in one] == []  # the name of SVG is no address


def test_everything_named_by_the_scripts_is_on_the_page() -> None:
    page = set(re.findall(r'id="([\w-]+)"', text("index.html")))
    for name in ("main.js", "stage.js"):
        wanted = set(re.findall(r'\$\("([\w-]+)"\)', text(name)))
        assert wanted <= page, wanted - page


def test_every_control_has_a_name() -> None:
    page = text("index.html")
    for control in re.findall(r"<button[^>]*>.*?</button>", page):
        assert re.search(r'aria-label="\w', control) or re.search(r">\s*\w+", control), control
    for given in re.findall(r'<input id="([\w-]+)"', page):
        inside = re.search(rf'<label[^>]*>[^<]*<input id="{given}"', page)
        assert inside or f'for="{given}"' in page, given
