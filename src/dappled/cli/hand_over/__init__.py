"""`dappled hand-over odm`: give pictures to a program elsewhere that makes models of them, and fetch the results."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dappled import durable, key_files
from dappled.cli.table import words_only
from dappled.cli.verb import Output, Overwriting, Report, Verb, argument, option
from dappled.errors import CallError, DappledError, counted

if not words_only:
    from dappled.flight import disk_error, disk_errors
    from dappled.products.handover import nodeodm
    from dappled.products.handover.nodeodm import NodeOdm, NodeOdmError

TOKEN_VARIABLE = "DAPPLED_NODEODM_TOKEN"  # noqa: S105  # a name


def _option(word: str) -> tuple[str, str]:
    name, sign, value = word.partition("=")
    if not sign or not name:
        raise ValueError(f"{word}: write an option as name=value, such as dsm=true")
    return name, value


@dataclass(frozen=True, kw_only=True)
class HandOver(Overwriting, Verb):
    """Give pictures to another program."""

    examples = (
        "dappled hand-over odm http://127.0.0.1:3000 products/FLIGHT/photos/jpeg    (of dappled batch --as photos)",
        "dappled hand-over odm http://10.0.0.9:3000 products/FLIGHT/photos/jpeg --option dsm=true -o model.zip",
        "dappled hand-over odm http://10.0.0.9:3000 --task UUID -o model.zip",
    )

    program: str = argument("PROGRAM", "odm: OpenDroneMap, by its NodeODM server", choices=("odm",))
    url: str = argument("URL", "the server, such as http://127.0.0.1:3000")
    pictures: Path | None = argument(
        "DIR", "folder of pictures with positions, and geo.txt if it is there", default=None, there=True
    )
    task: str | None = option(
        "--task", "go on with a task that was sent earlier, in place of DIR", None, metavar="UUID",
    )  # fmt: skip
    output: Path | None = option(
        "-o --output", "wait for the task's end, and put its results here", None, metavar="FILE.zip",
        otherwise="only start it",
    )  # fmt: skip
    name: str | None = option("--name", "the task's name", None, metavar="WORDS", otherwise="the folder's")
    options: tuple[tuple[str, str], ...] = option(
        "--option", "an option of OpenDroneMap, such as dsm=true; may be repeated", (), append=True, parse=_option,
        metavar="NAME=VALUE",
    )  # fmt: skip
    token_file: Path | None = option(
        "--token-file", "file with the server's token, where it wants one, for no other user to read (or set "
        f"{TOKEN_VARIABLE}); the command line is for every user to read", None, there=True,
    )  # fmt: skip

    def check(self) -> None:
        if (self.pictures is None) == (self.task is None):
            raise CallError("name the folder of the pictures, or with --task one that was sent earlier, not both")
        if self.task is not None and (self.options or self.name):
            raise CallError(f"--name and --option are those of a new task: leave them out with --task {self.task}")
        if self.output is not None:
            self.refuse_existing(self.output)
            _check_writable(self.output)

    def run(self, output: Output) -> Report:
        return self.hand_over(output, time.sleep, time.monotonic)

    def hand_over(self, output: Output, wait: Callable[[float], None], now_s: Callable[[], float]) -> Report:
        """Do the work by a clock. Raises DappledError."""
        server = NodeOdm(self.url, _token(self.token_file), wait=wait, now_s=now_s)
        files = [] if self.pictures is None else nodeodm.pictures(self.pictures)
        version = server.version()
        task = self.task
        if task is None:
            assert self.pictures is not None
            task = server.begin(self.name or self.pictures.absolute().name, dict(self.options))
            output.remark(f"task {task} at {self.url}")
            server.send(task, files, output.show)
        if self.output is not None:
            self._results(server, task, self.output, output)
        facts: dict[str, Any] = {"task": task, "url": self.url, "pictures": len(files), "version": version}
        facts["file"] = None if self.output is None else str(self.output)
        said = f"task {task}: {counted(len(files), 'file')} sent to {self.url} (NodeODM {version})"
        if self.pictures is None:
            now = server.task(task)
            facts |= {"progress": now.progress, "completed": now.completed}
            said = f"task {task} at {self.url} (NodeODM {version}): {now.words}"
        return Report(facts, [said + ("" if self.output is None else f", results in {self.output}")])

    def _results(self, server: NodeOdm, task: str, to: Path, output: Output) -> None:
        """Raises NodeOdmError and DappledError, which say how to go on; an interruption says it, too."""
        again = f"dappled hand-over odm {self.url} --task {task} -o {to}"
        try:
            server.results(task, to, output.show)
        except nodeodm.NoAnswerError as error:
            raise NodeOdmError(f"{error}; the task goes on there. Fetch it later: {again}") from None
        except OSError as error:
            raise DappledError(f"{disk_error('write', to, error)}; then fetch the results: {again}") from None
        except KeyboardInterrupt:
            output.remark(f"the task goes on there. Fetch it later: {again}")
            raise


def _check_writable(path: Path) -> None:
    """Raises DappledError where results could not be put there: better before hours of work than after."""
    part = durable.temporary(path)
    with disk_errors("write", path):
        if path.is_dir():
            raise DappledError(f"{path} is a folder: -o names the file of the results, such as {path / 'model.zip'}")
        durable.make_folder(path.parent)
        os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644))
        part.unlink()


def _token(file: Path | None) -> str:
    """The server's token, "" for none. Raises KeyFileError for a file that others can read."""
    if file is None:
        return os.environ.get(TOKEN_VARIABLE, "")
    return key_files.read(file.expanduser(), "the server's token").strip()
