"""Let every call of a verb fail, one after the other, each in a process of its own: `fault_server.py VERB PLACE STEP`.

Runs with `faults.c` preloaded. A verb that meets a fault either ends well or says a sentence (DappledError); afterwards
no acknowledged frame is lost, and the verb called again comes to its end. Prints a line of JSON at the end.
"""

from __future__ import annotations

import ctypes
import errno
import json
import os
import shutil
import sys
import traceback
from pathlib import Path

from dappled.errors import DappledError
from dappled.flight import recording
from tests.flight import verbs
from tests.flight.verbs import VERBS

FAULTS = {"EIO": errno.EIO, "ENOSPC": errno.ENOSPC, "EMFILE": errno.EMFILE}
shim = ctypes.CDLL(None)


def child(place: Path, name: str, at: int, error: int, lasting: bool) -> tuple[int, str, int]:
    """(0 ended well, 1 said a sentence, 2 anything else; what it said; how many calls there were)."""
    inward, outward = os.pipe()
    pid = os.fork()
    if pid == 0:
        said: list[str] = []
        shim.faults_root(str(place).encode())
        shim.faults_arm(ctypes.c_long(at), error, int(lasting))
        code, text = 0, ""
        try:
            VERBS[name].act(place, said.append)
        except DappledError as caught:
            code, text = 1, str(caught)
        except BaseException:  # noqa: BLE001  the very thing that is looked for
            code, text = 2, traceback.format_exc()
        calls = shim.faults_count()
        shim.faults_root(b"")
        os.write(outward, json.dumps([code, text[-3000:], calls, said]).encode())
        os._exit(0)
    os.close(outward)
    with os.fdopen(inward) as pipe:
        code, text, calls, said = json.loads(pipe.read())
    os.waitpid(pid, 0)
    for line in said:
        _, frame, sha256 = line.split()
        PROMISE[frame] = sha256
    return code, text, calls


PROMISE: dict[str, str] = {}


def main(name: str, place: Path, step: int) -> None:
    pristine, at_work = place / "pristine", place / "work"
    VERBS[name].prepare(pristine)
    promised = verbs.promised(pristine)

    def fresh() -> None:
        shutil.rmtree(at_work, ignore_errors=True)
        shutil.copytree(pristine, at_work)
        PROMISE.clear()
        PROMISE.update(promised)

    fresh()
    code, text, calls = child(at_work, name, 0, 0, lasting=False)
    assert code == 0, text
    wrong: list[str] = []
    faults = refused = 0
    for at in range(1, calls + 1):
        for word, error in FAULTS.items():
            for lasting in (False, True):
                faults += 1
                if faults % step:
                    continue
                fresh()
                code, text, _ = child(at_work, name, at, error, lasting)
                where = f"{name}: {word} at call {at} of {calls}{' and from then on' if lasting else ''}"
                refused += code == 1
                if code == 2:
                    wrong.append(f"{where}: {text}")
                wrong += [f"{where}: {frame} is lost ({text})" for frame in verbs.lost(at_work, PROMISE)]
                recording.begin(at_work / "flights", verbs.clock()).close()
                code, text, _ = child(at_work, name, 0, 0, lasting=False)
                left = [*verbs.lost(at_work, PROMISE), *(VERBS[name].settled(at_work) if code == 0 else [text])]
                wrong += [f"{where}, called again: {one}" for one in left]
    print(json.dumps({"calls": calls, "faults": faults // step, "refused": refused, "wrong": wrong}))  # noqa: T201


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))
