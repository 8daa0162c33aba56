"""Pictures handed to a NodeODM server: a small server that keeps to its API says what came, and what was left."""

from __future__ import annotations

import email.parser
import email.policy
import io
import json
import shutil
import threading
import urllib.parse
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from dappled.cli import main
from dappled.cli.command_line import check, read
from dappled.cli.hand_over import HandOver
from dappled.cli.rendering import TerminalOutput, told
from dappled.products.handover.nodeodm import NodeOdmError


class FakeNodeOdm(ThreadingHTTPServer):
    """One task; `fails` names a path that is answered with an error, `states` how the task is, asked by asked.

    `silent` counts the answers that a path still loses, by a part of it; the server does what was asked all the same.
    """

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Answers)
        self.tasks: dict[str, dict[str, bytes]] = {}
        self.options: list[dict[str, str]] = []
        self.committed: list[str] = []
        self.fails = ""
        self.states = [20, 20, 40]
        self.cut = 0
        self.silent: dict[str, int] = {}
        self.asked: list[str] = []
        self.results = ALL
        self.version, self.moved = "2.2.3", ""
        self.url = f"http://127.0.0.1:{self.server_port}"


def _archive() -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("odm_report/report.pdf", b"all")
    return made.getvalue()


ALL = _archive()


def named(part: Any) -> tuple[str, bytes]:
    """The name of a form's part, of a file its own, and its content."""
    words = [part.get_param(kind, header="content-disposition") for kind in ("filename", "name")]
    return str(next(word for word in words if word)), part.get_payload(decode=True)


class Answers(BaseHTTPRequestHandler):
    server: FakeNodeOdm

    def log_message(self, *_: Any) -> None:
        """Silent."""

    def do_GET(self) -> None:
        self.server.asked.append(self.path)
        if self.lost():
            return
        if self.server.moved:
            self.send_response(302)
            self.send_header("location", self.server.moved + self.path)
            self.end_headers()
        elif self.path.startswith("/info"):
            self.say({"version": self.server.version})
        elif self.path.partition("?")[0].endswith("/info"):
            state = self.server.states.pop(0)
            self.say({"uuid": "one", "progress": 50, "status": {"code": state, "errorMessage": "out of memory"}})
        else:
            self.send_response(200)
            self.send_header("content-length", str(len(self.server.results) + self.server.cut))
            self.end_headers()
            self.wfile.write(self.server.results)

    def lost(self) -> bool:
        """Whether the answer is lost on its way, half of it sent."""
        for part, left in self.server.silent.items():
            if left and part in self.path:
                self.server.silent[part] -= 1
                self.send_response(200)
                self.send_header("content-length", "1000")
                self.end_headers()
                return True
        return False

    def do_POST(self) -> None:
        data = self.rfile.read(int(self.headers["content-length"]))
        head = b"content-type: " + self.headers["content-type"].encode() + b"\r\n\r\n"
        form = email.parser.BytesParser(policy=email.policy.HTTP).parsebytes(head + data)
        parts = dict(map(named, form.iter_parts()))
        if self.server.fails and self.server.fails in self.path:
            self.say({"error": "no space"})
        elif self.path == "/task/new/init":
            self.server.tasks["one"] = {}
            self.server.options = json.loads(parts["options"])
            self.say({"uuid": "one"})
        elif "/upload/" in self.path:
            self.server.tasks["one"].update(parts)
            self.say({"success": True})
        elif "/commit/" in self.path:
            self.server.committed.append("one")
            self.say({"uuid": "one"})
        else:
            fields = urllib.parse.parse_qs(data.decode())  # as NodeODM: here it reads no multipart form
            del self.server.tasks[fields["uuid"][0]]
            self.say({"success": True})

    def say(self, value: dict[str, Any]) -> None:
        if self.command == "POST" and self.lost():
            return
        data = json.dumps(value).encode()
        self.send_response(200)
        self.send_header("content-length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


@pytest.fixture
def node() -> Iterator[FakeNodeOdm]:
    with FakeNodeOdm() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "jpeg"
    folder.mkdir()
    for name in ("000000.jpg", "000001.jpg", "geo.txt", "notes.md", ".hidden.jpg"):
        (folder / name).write_bytes(name.encode() * 100)
    return folder


def run(*words: str) -> int:
    """The command, by a clock that only its own waits move."""
    passed = [0.0]

    def wait(seconds: float) -> None:
        passed[0] += seconds

    verb = read(["hand-over", *words]).verb
    assert isinstance(verb, HandOver)
    check(verb)
    output = TerminalOutput("hand-over", as_json=verb.json)
    return told(verb, verb.hand_over(output, wait, lambda: passed[0]), output)


def test_a_task_is_begun_followed_and_fetched(
    node: FakeNodeOdm, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "model.zip"
    assert run("odm", node.url, str(photos), "-o", str(output), "--option", "dsm=true", "--json") == 0
    assert node.tasks["one"] == {name: name.encode() * 100 for name in ("000000.jpg", "000001.jpg", "geo.txt")}
    assert node.options == [{"name": "dsm", "value": "true"}]
    assert node.committed == ["one"]
    assert output.read_bytes() == ALL
    assert json.loads(capsys.readouterr().out)["task"] == "one"
    assert main(["hand-over", "odm", node.url, str(photos), "-o", str(output)]) == 1
    assert "model.zip exists already" in capsys.readouterr().err


def test_a_refusal_is_not_kept_as_results(node: FakeNodeOdm, photos: Path, tmp_path: Path) -> None:
    node.results = b'{"error": "Asset not ready"}'
    with pytest.raises(NodeOdmError, match="sent no results for task one: Asset not ready"):
        run("odm", node.url, str(photos), "-o", str(tmp_path / "model.zip"))
    assert not (tmp_path / "model.zip").exists()


def test_lost_answers_lose_no_task(node: FakeNodeOdm, photos: Path, tmp_path: Path) -> None:
    """A picture is sent again, a start is looked up, and questions and results are asked for again for ten minutes."""
    node.silent = {"/upload/": 4, "/commit/": 1, "one/info": 100, "/download/": 100}
    node.states = [10, 20, 40]
    assert run("odm", node.url, str(photos), "-o", str(tmp_path / "model.zip")) == 0
    assert node.tasks["one"] == {name: name.encode() * 100 for name in ("000000.jpg", "000001.jpg", "geo.txt")}
    assert node.committed == ["one"]
    assert (tmp_path / "model.zip").read_bytes() == ALL


@pytest.mark.parametrize("silent", ["one/info", "/download/"])
def test_a_task_whose_server_went_away_is_gone_on_with(
    node: FakeNodeOdm, photos: Path, tmp_path: Path, silent: str, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "model.zip"
    node.silent = {silent: 10**6}
    with pytest.raises(NodeOdmError) as refused:
        run("odm", node.url, str(photos), "-o", str(output))
    again = f"dappled hand-over odm {node.url} --task one -o {output}"
    assert str(refused.value).endswith(f"; the task goes on there. Fetch it later: {again}")
    assert f"task one at {node.url}" in capsys.readouterr().err
    assert "one" in node.tasks
    assert not output.exists()
    node.silent, node.states = {}, [20, 40, 40]
    sent = len(node.committed)
    assert run(*again.split()[2:]) == 0
    assert output.read_bytes() == ALL
    assert "is done, results in" in capsys.readouterr().out
    node.states = [20]
    assert run("odm", node.url, "--task", "one") == 0
    assert "is being processed, 50 % done" in capsys.readouterr().out
    assert len(node.committed) == sent


def test_results_that_could_not_be_written_are_said_before_anything_is_sent(
    node: FakeNodeOdm, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for output in (photos / "000000.jpg" / "model.zip", photos):
        assert main(["hand-over", "odm", node.url, str(photos), "--overwrite", "-o", str(output)]) == 1
        assert str(output) in capsys.readouterr().err
    assert node.asked == []


@pytest.mark.parametrize("words", [(), (".", "--task", "one"), ("--task", "one", "--name", "field")])
def test_a_task_is_new_or_an_earlier_one(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hand-over", "odm", "http://127.0.0.1:9", *words]) == 2
    assert "--task" in capsys.readouterr().err


@pytest.mark.parametrize("fails", ["/upload/", "/commit/"])
def test_what_could_not_be_sent_whole_leaves_no_task(
    node: FakeNodeOdm, photos: Path, fails: str, capsys: pytest.CaptureFixture[str]
) -> None:
    node.fails = fails
    assert main(["hand-over", "odm", node.url, str(photos)]) == 1
    assert f"{node.url} refuses: no space" in capsys.readouterr().err
    assert (node.tasks, node.committed) == ({}, [])


def test_a_task_that_fails_or_a_transfer_that_breaks_off_leaves_no_file(
    node: FakeNodeOdm, photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    node.states = [30]
    words = ["hand-over", "odm", node.url, str(photos), "-o", str(tmp_path / "model.zip")]
    assert main(words) == 1
    assert "task one" in (said := capsys.readouterr().err)
    assert "has failed: out of memory" in said
    node.states, node.cut = [40], 1
    with pytest.raises(NodeOdmError, match=r"(broke off|ended) the transfer .*; the task goes on there"):
        run(*words[1:])
    assert sorted(path.name for path in tmp_path.iterdir()) == ["jpeg"]


def test_results_without_an_end_fill_no_disk(
    node: FakeNodeOdm, photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10**8))
    with pytest.raises(NodeOdmError, match="has less than 1 GB free left"):
        run("odm", node.url, str(photos), "-o", str(tmp_path / "model.zip"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["jpeg"]


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("http://127.0.0.1:9", "jpeg"), "no NodeODM server answers at http://127.0.0.1:9"),
        (("127.0.0.1:3000", "jpeg"), "is no address of a NodeODM server"),
        (("http://[::1", "jpeg"), "is no address of a NodeODM server"),
        (("http://me:secret@127.0.0.1:9", "jpeg"), "holds no user and no password"),
        (("http://127.0.0.1:9", "empty"), "empty holds no pictures"),
    ],
)
def test_what_can_t_be_handed_over_is_one_sentence(
    photos: Path, words: tuple[str, str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (photos.parent / "empty").mkdir()
    assert main(["hand-over", "odm", words[0], str(photos.parent / words[1])]) == 1
    said = capsys.readouterr().err
    assert says in said
    assert "secret" not in said
    assert said.count("\n") == 1


def test_the_token_comes_from_a_private_file_or_the_environment(
    node: FakeNodeOdm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "token"
    file.write_text("from-a-file\n")
    file.chmod(0o644)
    words = ("odm", node.url, "--task", "one")
    assert main(["hand-over", *words, "--token-file", str(file)]) == 2
    assert "can be used by others than its owner: chmod 600" in capsys.readouterr().err
    file.chmod(0o600)
    assert run(*words, "--token-file", str(file)) == 0
    monkeypatch.setenv("DAPPLED_NODEODM_TOKEN", "from-the-environment")
    assert run(*words) == 0
    assert [asked.partition("token=")[2] for asked in node.asked] == 2 * ["from-a-file"] + 2 * ["from-the-environment"]


def test_a_redirection_tells_no_token_and_a_version_moves_no_cursor(
    node: FakeNodeOdm, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DAPPLED_NODEODM_TOKEN", "a-secret")
    node.version = "2\x1b[2J"
    assert main(["hand-over", "odm", node.url, "--task", "one"]) == 0
    assert "\x1b" not in capsys.readouterr().out
    node.moved = "https://a:secret@elsewhere.example"
    assert main(["hand-over", "odm", node.url, "--task", "one"]) == 1
    said = capsys.readouterr().err
    assert "https://elsewhere.example/info" in said
    assert "secret" not in said
    node.moved = "https://[secret"  # no address at all
    assert main(["hand-over", "odm", node.url, "--task", "one"]) == 1
    said = capsys.readouterr().err
    assert "a redirection to what is no address" in said
    assert "secret" not in said
