"""`dappled mask kit`: write what a person prints and shoots to settle which law a camera obeys."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dappled.cli.mask.arguments import FILM_NAMES
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, argument, flag, option

if not words_only:
    import numpy as np
    import tomli_w
    from numpy.typing import NDArray
    from PIL import Image

    from dappled.config import profiles
    from dappled.config.profiles import CameraProfile
    from dappled.decode.optics import Mask, film
    from dappled.decode.optics.carriers import Pattern
    from dappled.decode.optics.film import FILMS, Film, MaskImage, period_on
    from dappled.products.exports import mask_files

_WEDGE_STEPS = 21
_PAGE_MM, _PAGE_PX_PER_MM = (297.0, 210.0), 12.0  # A4
_BAR_MM = 100
_LENGTHS = 3  # focal lengths: with three, a law's second constant is fitted, too
_STOPS = (11.0, 22.0, 32.0)
KIT = "kit.toml"
_MASKS: tuple[Pattern, ...] = ("full", "diagonal")


@dataclass(frozen=True, kw_only=True)
class WriteTestKit(Overwriting, Verb):
    """Write what to print and shoot."""

    examples = ("dappled mask kit kit --camera canon-eos-450d --film 8k",)

    folder: Path = argument("FOLDER", "folder to write, made where it is missing")
    camera: str = option("--camera", "camera profile or TOML file")
    film: str = option("--film", "film of the mask", "8k", choices=FILM_NAMES)
    frequency: float = option(
        "--frequency", "fundamental frequency of both masks", 11.38, unit="1/mm", above=0.0,
        otherwise="Mask 2's 11.38",
    )  # fmt: skip
    negative: bool = flag("--negative", "write negatives (Eq 13), for negative film")

    def _files(self) -> list[Path]:
        masks = [self.folder / f"{name}.{ending}" for name in _MASKS for ending in ("png", "toml")]
        return masks + [self.folder / name for name in ("wedge.png", "target.png", "shots.txt", KIT)]

    def check(self) -> None:
        profiles.camera(self.camera)
        self.refuse_existing(*self._files())

    def run(self, output: Output) -> Report:
        camera, chosen, folder = profiles.camera(self.camera), FILMS[self.film], self.folder
        masks = {name: Mask(self.frequency, 2, name, "linear") for name in _MASKS}
        folder.mkdir(parents=True, exist_ok=True)
        for name, mask in masks.items():
            image = MaskImage(mask, chosen, period_on(chosen, mask), self.negative, 8, None, False)
            for text in image.warnings():
                output.warn(f"warning: {text}")
            mask_files.write(folder / f"{name}.png", chosen.shape, 8, chosen.px_per_mm, image.levels)
            (folder / f"{name}.toml").write_text(
                f'p = 2\nfrequency_per_mm = {self.frequency}\npattern = "{name}"\nharmonics = "linear"\n'
            )
        mask_files.write(folder / "wedge.png", chosen.shape, 8, chosen.px_per_mm, _wedge(chosen))
        Image.fromarray(_target()).save(folder / "target.png", dpi=(25.4 * _PAGE_PX_PER_MM,) * 2)
        lengths, stops = shot_list(camera)
        named = str(Path(self.camera).resolve()) if self.camera.endswith(".toml") else self.camera
        asked = {"camera": named, "focal_lengths_mm": lengths, "f_numbers": stops}
        (folder / KIT).write_text(tomli_w.dumps(asked))
        (folder / "shots.txt").write_text(_shots(camera, named, chosen, folder))
        files = [str(one) for one in self._files()]
        return Report({"files": files}, files)


def _wedge(chosen: Film) -> Callable[[slice, slice], NDArray[np.uint8]]:
    levels = np.rint(film.wedge((1, chosen.shape[1]), _WEDGE_STEPS) * 255).astype(np.uint8)
    return lambda rows, columns: np.repeat(levels[:, columns], rows.stop - rows.start, axis=0)


def _target() -> NDArray[np.uint8]:
    """A page of blocks of many sizes, which is textured at every distance, with a bar of 10 × 10 mm below it."""
    rng = np.random.default_rng(1)
    high, wide = (round(side * _PAGE_PX_PER_MM) for side in _PAGE_MM)
    page = np.zeros((high, wide))
    for block in (6, 12, 24, 48, 96, 192):
        cells = rng.uniform(-1, 1, (-(-high // block), -(-wide // block)))
        page += np.kron(cells, np.ones((block, block)))[:high, :wide]
    values = np.where(page > 0, 235, 30).astype(np.uint8)
    top, step = high - round(25 * _PAGE_PX_PER_MM), round(10 * _PAGE_PX_PER_MM)
    values[top:] = 255
    left = (wide - _BAR_MM // 10 * step) // 2
    for part in range(_BAR_MM // 10):
        columns = slice(left + part * step, left + (part + 1) * step)
        values[top + step // 2 : top + step * 3 // 2, columns] = 0 if part % 2 == 0 else 190
    return values


def shot_list(camera: CameraProfile) -> tuple[list[float], list[float]]:
    """(focal lengths in mm, f-numbers) to shoot with each mask."""
    low, high = camera.focal_length_mm or (18.0, 55.0)
    lengths = np.unique(np.round(np.geomspace(low, high, _LENGTHS)))
    widest, narrowest = camera.f_numbers or (1.0, 64.0)
    return lengths.tolist(), [stop for stop in _STOPS if widest <= stop <= narrowest] or [narrowest]


def _shots(camera: CameraProfile, named: str, chosen: Film, folder: Path) -> str:
    """What to print, measure, mount and shoot, in order, with the commands that read it."""
    lengths, stops = shot_list(camera)
    lines = [
        f"Kit for {camera.name}, film {chosen.name}",
        "",
        "Print full.png, diagonal.png and wedge.png on film at 100 %, target.png on A4 at 100 %.",
        f"[ ] the bar of target.png measures {_BAR_MM} mm: ______ mm",
        f"[ ] the film's image is {chosen.horizontal.length_mm:g} mm wide: ______ mm (print scale: divide)",
        "[ ] density of each of the wedge's 21 steps, if a densitometer is at hand: density.csv (docs/masks.md, 4)",
        f"[ ] distance from film to sensor: ______ mm (stated: {camera.mask_distance_mm:g})",
        "",
        "Shoot raw, at base ISO, focused at infinity, on an evenly lit white wall out of focus; no pixel clipped.",
        "First without a mask, then the diagonal, then the full mask:",
    ]
    for name in ("bare", "diagonal", "full"):
        lines += [f"[ ] {name}: {length:g} mm at f/{stop:g}" for length in lengths for stop in stops]
    lines += [
        "[ ] full: target.png at 1 m and at 4 m, widest stop, one focal length",
        "",
        "Put the files into the folders bare, diagonal and full, and read them:",
        f"    dappled calibrate --kit {folder} -o calibration.toml",
        "It names the law, the distance and the print's scale with their errors for each mask, whether both agree, and",
        "what is missing; or it says what can't be told, and ends with 1. The calibration is the full mask's. One",
        "mask alone:",
        f"    dappled calibrate full/* --camera {named} --mask full.toml -o full-calibration.toml",
    ]
    return "\n".join(lines) + "\n"
