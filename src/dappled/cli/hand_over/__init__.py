"""`dappled hand-over odm`: give pictures to a program elsewhere that makes models of them, and fetch the results."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from dappled import durable
from dappled.cli.arguments import add_overwrite, refuse_existing
from dappled.cli.georeference import Bar
from dappled.daemon.stream.curve import read_private
from dappled.errors import DappledError, counted
from dappled.flight import disk_error
from dappled.products.handover import nodeodm
from dappled.products.handover.nodeodm import NodeOdm, NodeOdmError
from dappled.products.maps.georeference import Progress

TOKEN_VARIABLE = "DAPPLED_NODEODM_TOKEN"  # noqa: S105  # a name


class HandOverCallError(DappledError):
    """What was asked for does not go together; one sentence."""

    exit_code: ClassVar[int] = 2


def configure(parser: argparse.ArgumentParser) -> None:
    parser.epilog = (
        "examples:\n"
        "  dappled batch FLIGHT --as photos -o products\n"
        "  dappled hand-over odm http://127.0.0.1:3000 products/FLIGHT/photos/jpeg\n"
        "  dappled hand-over odm http://10.0.0.9:3000 products/FLIGHT/photos/jpeg --option dsm=true -o model.zip\n"
        "  dappled hand-over odm http://10.0.0.9:3000 --task UUID -o model.zip"
    )
    parser.add_argument("program", choices=("odm",), help="odm: OpenDroneMap, by its NodeODM server")
    parser.add_argument("url", metavar="URL", help="the server, such as http://127.0.0.1:3000")
    parser.add_argument("pictures", type=Path, nargs="?", metavar="DIR",
                        help="folder of pictures with positions, and geo.txt if it is there")  # fmt: skip
    parser.add_argument("--task", metavar="UUID", help="go on with a task that was sent earlier, in place of DIR")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE.zip",
                        help="wait for the task's end, and put its results here (default: only start it)")  # fmt: skip
    add_overwrite(parser)
    parser.add_argument("--name", metavar="WORDS", help="the task's name (default: the folder's)")
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE",
                        help="an option of OpenDroneMap, such as dsm=true; may be repeated")  # fmt: skip
    parser.add_argument("--token-file", type=Path, metavar="FILE",
                        help=f"file with the server's token, where it wants one, for no other user to read (or set "
                             f"{TOKEN_VARIABLE}); the command line is for every user to read")  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print the task as JSON")


def run(
    arguments: argparse.Namespace,
    *,
    wait: Callable[[float], None] = time.sleep,
    now_s: Callable[[], float] = time.monotonic,
) -> int:
    if (arguments.pictures is None) == (arguments.task is None):
        raise HandOverCallError("name the folder of the pictures, or with --task one that was sent earlier, not both")
    if arguments.task is not None and (arguments.option or arguments.name):
        raise HandOverCallError(
            f"--name and --option are those of a new task: leave them out with --task {arguments.task}"
        )
    options = dict(_option(word) for word in arguments.option)
    if arguments.output is not None:
        refuse_existing(arguments, arguments.output)
        _check_writable(arguments.output)
    server = NodeOdm(arguments.url, _token(arguments.token_file), wait=wait, now_s=now_s)
    files = [] if arguments.pictures is None else nodeodm.pictures(arguments.pictures)
    version = server.version()
    with Bar() as progress:
        if arguments.pictures is None:
            task = arguments.task
        else:
            task = server.begin(arguments.name or arguments.pictures.absolute().name, options)
            print(f"task {task} at {arguments.url}", file=sys.stderr)
            server.send(task, files, progress)
        if arguments.output is not None:
            _results(server, task, arguments, progress)
    facts = {"task": task, "url": arguments.url, "pictures": len(files), "version": version}
    facts["file"] = None if arguments.output is None else str(arguments.output)
    said = f"task {task}: {counted(len(files), 'file')} sent to {arguments.url} (NodeODM {version})"
    if arguments.pictures is None:
        now = server.task(task)
        facts |= {"progress": now.progress, "completed": now.completed}
        said = f"task {task} at {arguments.url} (NodeODM {version}): {now.words}"
    said += "" if arguments.output is None else f", results in {arguments.output}"
    print(json.dumps(facts) if arguments.json else said)
    return 0


def _results(server: NodeOdm, task: str, arguments: argparse.Namespace, progress: Progress) -> None:
    """Raises NodeOdmError and DappledError, which say how to go on; an interruption says it, too."""
    again = f"dappled hand-over odm {arguments.url} --task {task} -o {arguments.output}"
    try:
        server.results(task, arguments.output, progress)
    except nodeodm.NoAnswerError as error:
        raise NodeOdmError(f"{error}; the task goes on there. Fetch it later: {again}") from None
    except OSError as error:
        raise DappledError(f"{disk_error('write', arguments.output, error)}; then fetch the results: {again}") from None
    except KeyboardInterrupt:
        print(f"the task goes on there. Fetch it later: {again}", file=sys.stderr)
        raise


def _check_writable(path: Path) -> None:
    """Raises DappledError where results could not be put there: better before hours of work than after."""
    part = durable.temporary(path)
    try:
        if path.is_dir():
            raise DappledError(f"{path} is a folder: -o names the file of the results, such as {path / 'model.zip'}")
        durable.make_folder(path.parent)
        os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o644))
        part.unlink()
    except OSError as error:
        raise disk_error("write", path, error) from None


def _token(file: Path | None) -> str:
    """The server's token, "" for none. Raises DappledError for a file that others can read."""
    if file is None:
        return os.environ.get(TOKEN_VARIABLE, "")
    return read_private(file.expanduser(), "the server's token").strip()


def _option(word: str) -> tuple[str, str]:
    name, sign, value = word.partition("=")
    if not sign or not name:
        raise DappledError(f"--option {word}: write an option as name=value, such as dsm=true")
    return name, value
