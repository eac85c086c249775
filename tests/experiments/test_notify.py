"""Who is told, by real commands and real servers; a hook that hangs changes nothing, an address is kept nowhere."""

import json
import logging
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from experiments.cli import frame
from experiments.control import messages, notify
from experiments.control.config import DeployConfig
from experiments.control.notify import Hook, Notifier, hidden
from tests import programs
from tests.hardware.script import logged
from tests.patience import PATIENCE_S

SECRET = "T0SECRET"


class Server(ThreadingHTTPServer):
    """A hook; with `hangs` it takes requests and answers none until `released`."""

    daemon_threads = True

    def __init__(self, hangs: bool = False, status: int = 200) -> None:
        self.lines: list[dict[str, str]] = []
        self.paths: list[str] = []
        self.hangs, self.status, self.released, self.asked = hangs, status, threading.Event(), threading.Event()
        super().__init__(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.serve_forever, daemon=True).start()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/hook/{SECRET}?key={SECRET}"


class Handler(BaseHTTPRequestHandler):
    def do_POST(self) -> None:
        server = self.server
        assert isinstance(server, Server)
        body = self.rfile.read(int(self.headers["Content-Length"]))
        server.asked.set()
        if server.hangs:
            server.released.wait(60.0)
        server.paths.append(self.path)
        server.lines.append(json.loads(body))
        self.send_response(server.status)
        self.end_headers()

    def log_message(self, format: str, *arguments: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server()
    yield made
    made.shutdown()
    made.server_close()


def deployed(folder: Path, *overrides: str, **variables: str) -> subprocess.CompletedProcess[str]:
    words = f"hydra.run.dir={folder}", "controller=pi", "scenario=hold", "scenario.minutes=[5]", *overrides
    return programs.run("experiments.deploy", *words, cwd=folder.parent, WITHOUT_FIGURES="1", **variables)


def test_an_address_is_told_of_start_and_end_and_stands_in_no_file(tmp_path: Path, server: Server) -> None:
    done = deployed(tmp_path / "run", f"notify={server.url}")
    assert done.returncode == 0, done.stderr
    assert [line["event"] for line in server.lines] == ["start", "end"]
    assert server.lines[1]["text"] == "completed"
    assert server.lines[0]["run"].endswith("run")
    assert server.paths == [f"/hook/{SECRET}?key={SECRET}"] * 2
    assert SECRET not in done.stdout + done.stderr
    files = [path for path in (tmp_path / "run").rglob("*") if path.is_file()]
    assert len(files) > 8
    assert not [path for path in files if SECRET.encode() in path.read_bytes()]
    assert "notify: env:DEPLOY_HOOK" in (tmp_path / "run" / "config.yaml").read_text()


def test_a_run_that_fails_says_so_by_a_command_of_the_environment(tmp_path: Path) -> None:
    told = tmp_path / "told.jsonl"
    (tmp_path / "hook.py").write_text(f"import sys; open({str(told)!r}, 'a').write(sys.stdin.read())")
    command = f"{sys.executable} {tmp_path / 'hook.py'}"
    done = deployed(
        tmp_path / "run", "notify=env:MY_HOOK", "backend=chibio", "backend.url=http://127.0.0.1:9", MY_HOOK=command
    )
    assert done.returncode == 1
    (line,) = map(json.loads, told.read_text().splitlines())
    assert line["event"] == "end"
    assert line["text"].startswith("failed: ")


def test_what_does_not_fit_into_the_queue_is_dropped_and_counted(tmp_path: Path, caplog) -> None:  # type: ignore[no-untyped-def]
    caplog.set_level(logging.INFO)
    server = Server(hangs=True)
    tell = Notifier(Hook(server.url), tmp_path)
    tell("alarm", "first")
    assert server.asked.wait(10.0)
    for _ in range(notify.WAITING + 5):
        tell("alarm", "more")
    assert tell.dropped == 5
    tell.close()  # comes back although the hook does not
    assert logged(caplog, messages.HookTally)[0]["dropped"] == 5
    assert SECRET not in caplog.text
    server.released.set()


class Counting:
    """Takes every second line, and keeps all of them."""

    name = "counting"

    def __init__(self) -> None:
        self.lines: list[dict[str, str]] = []

    def send(self, line: bytes) -> str:
        self.lines.append(json.loads(line))
        return "status 500" if len(self.lines) % 2 == 0 else ""

    def give_up(self) -> None:
        pass


def test_every_message_comes_in_order_and_what_was_not_taken_is_counted_and_said_once(tmp_path, caplog):
    caplog.set_level(logging.INFO)
    hook = Counting()
    tell = Notifier(hook, tmp_path)  # type: ignore[arg-type]
    told = [("start", "started: M0, M1", ""), ("alarm", "frozen: no news", "M1"), ("alarm", "jump: far", "M0"),
            ("hand_over", "by itself", "M1"), ("end", "completed", "")]  # fmt: skip
    for event, text, reactor in told:
        tell(event, text, reactor)
    tell.close()
    tell.close()
    assert [(m["event"], m["text"], m.get("reactor", "")) for m in hook.lines] == told
    assert {m["run"] for m in hook.lines} == {str(tmp_path)}
    assert (tell.sent, tell.failed, tell.dropped) == (3, 2, 0)
    assert logged(caplog, messages.HookFailed) == [{"hook": "counting", "why": "status 500"}]
    tally = {"hook": "counting", "sent": 3, "failed": 2, "dropped": 0, "left": 0}
    assert logged(caplog, messages.HookTally) == [tally]


def test_a_hook_of_the_environment_is_used_and_one_that_is_wrong_stops_no_run_that_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("OTHER_HOOK", "no-such-command")
    for value, name, key, told in (
        ("  cat -  \n", "cat", "_command", ["cat", "-"]), (" https://h/T0 ", "https://h/…", "_target", "https://h/T0")
    ):  # fmt: skip
        monkeypatch.setenv("MY_HOOK", value)
        tell = notify.opened("env:MY_HOOK", tmp_path, resumed=False)
        assert (tell._hook.name, getattr(tell._hook, key)) == (name, told)
        tell.close()
    monkeypatch.setenv("MY_HOOK", "  ")
    with pytest.raises(messages.NotSet):
        notify.opened("env:MY_HOOK", tmp_path, resumed=False)
    notify.opened("env:MY_HOOK", tmp_path, resumed=True)("end", "nobody is told")
    assert len(logged(caplog, messages.HookUnusable)) == 1
    with pytest.raises(messages.NoCommand):
        notify.opened("env:OTHER_HOOK", tmp_path, resumed=False)
    caplog.clear()
    nobody = notify.opened("env:OTHER_HOOK", tmp_path, resumed=True)
    nobody("end", "nobody is told")
    assert nobody._hook is None
    assert len(logged(caplog, messages.HookUnusable)) == 1
    assert notify.opened("", tmp_path, resumed=False)._hook is None
    for wrong, why in (
        ("cat 'open", r"cannot be read \(No closing"),
        ("https:///x", "address has no host"),
    ):
        with pytest.raises(frame.UserError, match=why):
            notify.opened(wrong, tmp_path, resumed=False)


def living(number: int) -> bool:
    """Whether a process is at work; one that ended may wait for somebody who asks how."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(") ")[2][0] not in "ZX"
    except OSError:
        return False


def test_a_command_that_hangs_is_ended_with_its_children(tmp_path: Path) -> None:
    """A script that waits for a program of its own: neither is left, however often an alarm comes."""
    pids = tmp_path / "pids"
    hook = Hook(f"sh -c 'sleep 600 & echo $$ $! > {pids}; wait'", limit_s=3.0)
    assert hook.send(b"{}\n") == "TimeoutExpired"
    both = [int(number) for number in pids.read_text().split()]
    assert len(set(both)) == 2
    deadline = time.monotonic() + PATIENCE_S
    while left := [number for number in both if living(number)]:
        assert time.monotonic() < deadline, left
        time.sleep(0.02)


@pytest.mark.parametrize("status", [301, 403, 500])  # one who is elsewhere has not heard either
def test_what_a_hook_answers_is_said_without_the_address(status: int, caplog) -> None:  # type: ignore[no-untyped-def]
    server = Server(status=status)
    hook = Hook(server.url)
    assert hook.name == "http://127.0.0.1/…"
    assert hook.send(b"{}\n") == f"status {status}"
    server.shutdown()
    server.server_close()
    assert hook.send(b"{}\n") == "ConnectError"
    with pytest.raises(frame.UserError, match="notify: there is no such command"):
        Hook("no-such-command --now")
    assert Hook("false").send(b"{}\n") == "exit status 1"
    assert SECRET not in caplog.text


def test_what_a_command_writes_is_seen(capfd: pytest.CaptureFixture[str]) -> None:
    assert Hook("cat").send(b'{"event": "start"}\n') == ""
    assert capfd.readouterr().out == '{"event": "start"}\n'


def test_the_command_line_is_cleaned_of_an_address() -> None:
    environment: dict[str, str] = {}
    given = ["backend=sim", f"+notify=https://h/{SECRET}=1"]
    assert hidden(given, environment) == ["backend=sim", "notify=env:DEPLOY_HOOK"]
    assert environment == {"DEPLOY_HOOK": f"https://h/{SECRET}=1"}
    assert hidden(["notify=mail lab"], environment) == ["notify=mail lab"]
    assert hidden([f"notify='HTTP://h/{SECRET}'", "pair=https://x"], environment) == [
        "notify=env:DEPLOY_HOOK", "pair=https://x",
    ]  # fmt: skip
    assert environment == {"DEPLOY_HOOK": f"HTTP://h/{SECRET}"}


def test_an_address_in_a_file_is_refused() -> None:
    with pytest.raises(ValueError, match="notify: an address is a secret") as error:
        DeployConfig(notify=f"https://h/{SECRET}")
    assert SECRET not in str(error.value)
