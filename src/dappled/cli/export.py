"""`dappled export`: write light fields in the formats that other tools read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dappled import codec
from dappled.cli.field_arguments import FieldArguments, RangingArguments, doubts, opened_field, views_words
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, flag, option
from dappled.errors import CallError, DappledError

if not words_only:
    from dappled.products.exports import exports, light_files
    from dappled.products.opened import OpenedLightField

KINDS = {
    "hci": "HCI benchmark folder: one PNG per view, parameters.cfg; with --depth also disp_estimate.pfm",
    "eslf": "ESLF: one 16-bit PNG with a lenslet for each pixel of a view; the lenslet's size is in a .txt beside it",
    "mat": "MATLAB v5 in LFToolbox's layout: LF [t, s, v, u, c]",
    "quilt": "quilt PNG for light-field displays; its name gives columns, rows and aspect",
    "h5": "HDF5: the whole light field", "npz": "NumPy: the whole light field", "zarr": "Zarr: the whole light field",
    "rerun": "Rerun recording (.rrd): views, picture, depth",
}  # fmt: skip
_WHOLE = ("h5", "npz", "zarr")
_REPLACED = (*_WHOLE, "rerun")


@dataclass(frozen=True, kw_only=True)
class ExportLightField(Overwriting, RangingArguments, FieldArguments, Verb):
    """Write light fields for other tools."""

    examples = ("dappled export frame.zarr --as hci -o hci/frame",)
    notes = "formats:\n" + "\n".join(f"  {name:6} {what}" for name, what in KINDS.items())

    kind: str = option("--as", "the format", choices=tuple(KINDS))
    depth: bool = flag("--depth", "hci, rerun: add a depth map (method combined)")
    lenslet: int = option(
        "--lenslet", "eslf: side of a lenslet (LFToolbox: 14)", 0, unit="px", low=0,
    )  # fmt: skip
    disparity: float = option(
        "--disparity", "quilt: the disparity that appears in the plane of the screen", 0.0, metavar="D",
    )  # fmt: skip
    output: Path = option("-o --output", "file or folder to write", metavar="OUT")

    def check(self) -> None:
        """Refuse a call that is wrong by itself. A quilt's name is known only when it is made."""
        if self.kind in _WHOLE and self.output.suffix != f".{self.kind}":
            raise CallError(f"{self.output}: --as {self.kind} writes a .{self.kind} file; give it that ending")
        if self.kind in _REPLACED:
            self.refuse_existing(self.output)
        elif self.overwrite:
            raise CallError(f"--overwrite goes with --as {', '.join(_REPLACED)}: remove what is there yourself")
        elif self.kind != "quilt" and self.output.exists():
            raise DappledError(f"{self.output} exists already: move it away, or choose another name")

    def run(self, output: Output) -> Report:
        found = opened_field(self.field, self)
        written = self._write(found)
        words = views_words(found.field)
        if words and not self.json:
            output.remark(words)
        facts = {"file": str(written), "as": self.kind, "views": words or None, "doubts": codec.plain(found.doubts)}
        return Report(facts, [str(written)], findings=doubts(found))

    def _write(self, found: OpenedLightField) -> Path:
        """Write the light field; returns the path. Raises DappledError."""
        path = self.output
        match self.kind:
            case "hci":
                exports.hci(path, found.field, found.depth() if self.depth else None)
            case "eslf":
                exports.eslf(path, found.field, self.lenslet)
            case "mat":
                exports.mat(path, found.field)
            case "quilt":
                return exports.quilt(path, found.field, disparity=self.disparity)
            case "rerun":
                depth = found.depth() if self.depth else None
                distances = found.distances(depth) if depth is not None and found.ranging is not None else None
                exports.rerun(path, found.field, found.refocus(), depth, distances)
            case _:
                light_files.save(path, found.field, overwrite=self.overwrite)
        return path
