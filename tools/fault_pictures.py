"""A sheet of the console's twelve faults, for docs/console.md: python tools/fault_pictures.py docs/pictures

Puts together what tests/system/test_console_faults.py photographed in build/screenshots: faults-phone.webp (the first
screen's upper part, 390 px wide) and faults-laptop.webp (the left column, of 1280 px). Look at them before you commit.
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

SCREENSHOTS = Path(__file__).parents[1] / "build" / "screenshots"
SHEETS = {"phone": (390, (0, 56, 390, 470), 6), "laptop": (1280, (0, 44, 320, 404), 6)}  # width, part, columns
SCALE, CAPTION_PX = 0.6, 22


def main(folder: Path) -> None:
    for name, (width, part, columns) in SHEETS.items():
        found = sorted(SCREENSHOTS.glob(f"fault-*-{width}.png"))
        cell = round((part[2] - part[0]) * SCALE), round((part[3] - part[1]) * SCALE) + CAPTION_PX
        sheet = Image.new("RGB", (columns * cell[0], -(-len(found) // columns) * cell[1]), "white")
        pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(14)
        for at, path in enumerate(found):
            x, y = at % columns * cell[0], at // columns * cell[1]
            with Image.open(path) as picture:
                small = (
                    picture.convert("RGB").crop(part).resize((cell[0], cell[1] - CAPTION_PX), Image.Resampling.LANCZOS)
                )
            sheet.paste(small, (x, y + CAPTION_PX))
            fault = path.stem.removeprefix("fault-").removesuffix(f"-{width}").replace("-", " ")
            pen.text((x + 6, y + 3), fault, "black", font)
        sheet.save(folder / f"faults-{name}.webp", quality=80, method=6)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
