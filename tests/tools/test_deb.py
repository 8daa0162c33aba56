"""The Debian packages: what is in them, and that the command of one runs from where it would stand."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import dappled
from dappled.cli import VERBS
from tests.system.test_hostile_folder import HostileFolder

TOOL = Path(__file__).parents[2] / "tools" / "deb.py"
SUITES = {(3, 11): "bookworm", (3, 13): "trixie"}


def ask(*words: str | Path, **environment: str) -> str:
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, check=False, env={**os.environ, **environment}
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def ran_in_a_hostile_folder(tmp_path: Path, home: Path) -> str:
    """What of a folder that somebody else filled was run by the package's command, and by each verb of it."""
    wrapper = tmp_path / "root" / "usr" / "bin" / "dappled"
    text = wrapper.read_text(encoding="utf-8")
    assert "PYTHONPATH=/usr/lib/dappled exec /usr/bin/python3 -P " in text
    python = getattr(sys, "_base_executable", sys.executable)
    wrapper.write_text(text.replace("/usr/lib/dappled", str(home)).replace("/usr/bin/python3", python))
    (tmp_path / "hostile").mkdir()
    hostile = HostileFolder(tmp_path / "hostile")
    assert hostile.call(wrapper, "--version", PYTHONPATH=":").returncode == 0
    for words in (*([verb] for verb in VERBS), ["run", "--simulate", "--frames", "1"]):
        with contextlib.suppress(subprocess.TimeoutExpired):  # `run` and `open` go on
            hostile.call(wrapper, *words, timeout_s=6)
    return hostile.ran


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_package_is_built_for_each_architecture_and_its_command_runs(tmp_path: Path) -> None:
    if shutil.which("dpkg-deb") is None:
        pytest.skip("dpkg-deb is missing: no Debian package can be built here")
    suite = SUITES.get(sys.version_info[:2], "bookworm")
    said = ask(sys.executable, TOOL, "--suite", suite, "--out", tmp_path)
    debs = {path.stem.rpartition("_")[2]: path for path in tmp_path.glob("*.deb")}
    assert sorted(debs) == ["amd64", "arm64"]
    assert all(str(path) in said for path in debs.values())
    for arch, deb in debs.items():
        assert ask("dpkg-deb", "--field", deb, "Package", "Architecture").split() == [
            "Package:",
            "dappled",
            "Architecture:",
            arch,
        ]
        names = ask("dpkg-deb", "--contents", deb)
        for wanted in (
            "./usr/bin/dappled",
            "./etc/dappled/dappled.toml",
            "./usr/lib/systemd/system/dappled.service",
            "./usr/lib/systemd/system/dappled@.service",
            "./usr/lib/sysusers.d/dappled.conf",
            "./usr/lib/udev/rules.d/70-dappled-camera.rules",
            "./usr/lib/dappled/dappled/daemon/service.py",
        ):
            assert f" {wanted}\n" in names, (arch, wanted)
        assert "/tests/" not in names
        assert all(line.split()[1] == "root/root" for line in names.splitlines())
        machine = {"amd64": "x86_64", "arm64": "aarch64"}[arch]
        assert machine in names
        assert ({"x86_64", "aarch64"} - {machine}).pop() + "-linux-gnu.so" not in names
    machine = {"x86_64": "amd64", "aarch64": "arm64"}.get(os.uname().machine, "")
    if SUITES.get(sys.version_info[:2]) is None or machine not in debs:
        return  # no package of these is for this Python and machine
    ask("dpkg-deb", "--extract", debs[machine], tmp_path / "root")
    home = tmp_path / "root" / "usr" / "lib" / "dappled"
    run = (getattr(sys, "_base_executable", sys.executable), "-I", "-c")
    assert ran_in_a_hostile_folder(tmp_path, home) == ""
    code = f"import sys; sys.path[:0] = [{str(home)!r}]; import dappled, gphoto2, rawpy, zmq; print(dappled.__file__)"
    assert ask(*run, code).strip() == str(home / "dappled" / "__init__.py")
    code = (
        f"import sys; sys.path[:0] = [{str(home)!r}]; from dappled import errors; print(errors.install_extra('ground'))"
    )
    assert "on the ground, in an environment of its own" in ask(*run, code)


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_a_package_installs_in_a_bare_root_and_runs_in_a_hostile_folder_there(tmp_path: Path) -> None:
    """Debian's smallest system and Python, nothing else: what the package needs, it brings or depends on."""
    suite = SUITES.get(sys.version_info[:2], "bookworm")
    machine = {"x86_64": "amd64", "aarch64": "arm64"}.get(os.uname().machine)
    if shutil.which("mmdebstrap") is None or machine is None:
        pytest.skip("mmdebstrap is missing: no bare root can be made here")
    ask(sys.executable, TOOL, "--suite", suite, "--arch", machine, "--out", tmp_path)
    (deb,) = tmp_path.glob("*.deb")
    (tmp_path / "hostile").mkdir()
    hostile = HostileFolder(tmp_path / "hostile")
    verbs = [*VERBS, "open nothing.h5", "doctor --json"]
    tried = [
        f"cd {hostile.path}; export PYTHONPATH=: HOME={hostile.path}; exec </dev/null; set -x",
        f'test "$(dappled --version)" = "dappled {dappled.__version__}" || exit 8',
        "dappled run --simulate --frames 2 >out 2>&1; grep '^2 shots: ' out || { cat out; exit 7; }",  # however slow
        *(f"timeout 6 dappled {verb} >out 2>&1; case $? in 0|1|2|124) ;; *) cat out; exit 9; esac" for verb in verbs),
        "test ! -e ran",
    ]
    (tmp_path / "try.sh").write_text("\n".join(tried), encoding="utf-8")
    inside = f'"$1"{hostile.path}'
    hooks = [
        f'mkdir -p {inside} && cp {hostile.path}/*.py {tmp_path}/try.sh {inside} && cp {deb} "$1/tmp/dappled.deb"',
        'chroot "$1" dpkg -i /tmp/dappled.deb',
        f'chroot "$1" sh {hostile.path}/try.sh',
    ]
    ask(
        "mmdebstrap", "--variant=minbase", "--include=python3,systemd-standalone-sysusers",
        *(f"--customize-hook={hook}" for hook in hooks), "--format=null", suite, "/dev/null",
    )  # fmt: skip
