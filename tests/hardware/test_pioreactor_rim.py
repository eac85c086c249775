"""Doors of the Pioreactor driver: HTTP as it comes, a broker that refuses, a password that nobody sees."""

import getpass
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from hardware.clock import RealClock
from hardware.errors import LinkError, ProtocolError
from hardware.pioreactor.config import PASSWORD, PioreactorConfig
from hardware.pioreactor.messages import NoReply, NotHeard, ServerFailed
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.web import Web
from hardware.rig.build import broker
from tests.hardware.test_pioreactor_lock import real_broker
from tests.patience import PATIENCE_S

ROOT = Path(__file__).parents[2]


class Server(ThreadingHTTPServer):
    """Answers every request in the same way, and keeps what it was asked."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.status, self.body, self.asked = 200, b"{}", list[tuple[str, str, bytes]]()
        self.silent = threading.Event()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class Handler(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        server = self.server
        assert isinstance(server, Server)
        said = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        server.asked.append((self.command, self.path, said))
        if server.status == 0:  # silent until the test lets it speak
            server.silent.wait(PATIENCE_S)
        self.send_response(server.status or 200)
        self.send_header("Content-Length", str(len(server.body)))
        self.end_headers()
        self.wfile.write(server.body)

    do_POST = do_PATCH = do_GET

    def log_message(self, format: str, *args: object) -> None:
        pass


@contextmanager
def serving() -> Iterator[Server]:
    made = Server()
    threading.Thread(target=made.serve_forever, args=(0.01,), daemon=True).start()
    yield made
    made.silent.set()
    made.shutdown()
    made.server_close()


@pytest.fixture
def server() -> Iterator[Server]:
    with serving() as made:
        yield made


def test_a_proxy_of_the_environment_sees_no_request(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    server.status, server.body = 202, b'{"task_id": "t1"}'
    with serving() as proxy:
        proxy.status = 403
        for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
            monkeypatch.setenv(name, proxy.url)
        assert Web(server.url, "an experiment").run("add_media", {"ml": 0.5}) == "t1"
        assert proxy.asked == []
    ((method, path, said),) = server.asked
    assert (method, path) == ("POST", "/unit_api/jobs/run/job_name/add_media")
    asked = json.loads(said)
    assert asked["options"] == {"ml": 0.5}
    assert asked["env"]["EXPERIMENT"] == "an experiment"


@pytest.mark.parametrize(
    ("status", "raised"), [(400, NotHeard), (404, NotHeard), (429, NotHeard), (500, ProtocolError)]
)
def test_what_was_turned_away_was_not_heard_and_of_an_error_that_is_not_known(server, status, raised):
    server.status, server.body = status, b'{"error": "too many\\n requests"}'
    with pytest.raises(raised) as found:
        Web(server.url).run("add_media", {"ml": 0.5})
    assert (found.value.fields["status"], found.value.fields["reason"]) == (status, "too many requests")
    assert isinstance(found.value, NotHeard) == (raised is NotHeard)


@pytest.mark.parametrize(("status", "words"), [(503, "Service Unavailable"), (520, "")])
def test_an_error_of_the_web_server_is_told_in_its_words_with_what_helps_and_no_page_for_people(server, status, words):
    server.status, server.body = status, b"<!DOCTYPE html>\n<html><h1>503</h1></html>"
    with pytest.raises(ServerFailed) as found:
        Web(server.url).get("/active_calibrations")
    assert found.value.fields["status"] == status
    assert words in found.value.fields["reason"]
    assert "<" not in str(found.value)


@pytest.mark.parametrize("body", [b"", b"[]", b"<html>", b"[" * 100_000, b'{"task_id": 3}', b"\xff\xfe", b"null"])
def test_an_answer_that_is_none_is_named_and_may_have_been_heard(server, body):
    server.status, server.body = 202, body
    with pytest.raises(ProtocolError) as found:
        Web(server.url).run("add_media", {"ml": 0.5})
    assert not isinstance(found.value, NotHeard)
    assert len(str(found.value)) < 400


def test_nobody_there_was_not_heard_and_one_who_is_silent_may_have(server):
    with socket.socket() as taken:  # bound, and nobody listens
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(NotHeard):
            Web(f"http://127.0.0.1:{taken.getsockname()[1]}").run("add_media", {"ml": 0.5})
    server.status = 0
    with pytest.raises(NoReply) as found:
        Web(server.url, timeout_s=0.3).run("add_media", {"ml": 0.5})
    assert "board" not in str(found.value), "words of another family"
    assert not isinstance(found.value, NotHeard)


def test_a_unit_that_hangs_does_not_make_another_wait(server):
    with serving() as hanging:
        hanging.status = 0
        first, second = Web(hanging.url, timeout_s=PATIENCE_S), Web(server.url, timeout_s=PATIENCE_S)
        slow = first.ask(first.get, "/health")
        assert second.ask(second.get, "/health").result(PATIENCE_S) == {}
        assert not slow.done()
        hanging.silent.set()
        slow.result(PATIENCE_S)


# -- the broker's password ---------------------------------------------------------------------------------------------


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Of a broker that wants ada's password."""
    if broker() is None:
        pytest.skip("no MQTT broker: apt-get install mosquitto")
    secret = tmp_path / "secret"
    subprocess.run(["mosquitto_passwd", "-b", "-c", secret, "ada", "zebra-77"], check=True, capture_output=True)
    with real_broker(tmp_path, f"password_file {secret}\nuser {getpass.getuser()}") as number:
        yield number


def connected(port: int, **values: str) -> bool:
    config = PioreactorConfig(broker="127.0.0.1", broker_port=port, username="ada", **values)  # type: ignore[arg-type]
    reactors = PioreactorReactors(config, RealClock())
    try:
        reactors.connect()
        return reactors.mqtt.connected
    finally:
        reactors.close()


@pytest.mark.slow
def test_a_password_comes_from_the_environment_or_a_file_that_only_its_owner_reads(port, tmp_path, monkeypatch):
    monkeypatch.delenv(PASSWORD, raising=False)
    with pytest.raises(LinkError, match=r"Not authorized.*backend.password_file or the environment"):
        connected(port)
    monkeypatch.setenv(PASSWORD, "zebra-77")
    assert connected(port)
    monkeypatch.setenv(PASSWORD, "wrong")
    file = tmp_path / "password"
    file.write_text("zebra-77\n")
    file.chmod(0o600)
    assert connected(port, password_file=str(file))
    file.chmod(0o644)
    with pytest.raises(LinkError, match=r"backend.password_file = .*mode 644.*chmod 600") as found:
        connected(port, password_file=str(file))
    assert "zebra" not in str(found.value)
    with pytest.raises(LinkError, match=r"backend.password_file = .*No such file"):
        connected(port, password_file=str(tmp_path / "none"))


@pytest.mark.slow
def test_a_password_stands_in_no_file_of_a_run_and_a_refusal_is_a_line_of_the_preflight(port, tmp_path):
    given = [f"backend.broker_port={port}", "backend.broker=127.0.0.1", "backend.username=ada"]
    given += ["backend.units.pio01.address=http://127.0.0.1:9", "backend.leader=http://127.0.0.1:9"]
    for secret, said in (("zebra-77", "lets ada in"), ("tiger-88", "Not authorized")):
        folder = tmp_path / secret[:5]
        command = [sys.executable, "-m", "experiments.deploy", "backend=pioreactor", "preflight_only=true"]
        environment = {**os.environ, PASSWORD: secret, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            [*command, *given, f"hydra.run.dir={folder}"], capture_output=True, text=True, env=environment,
            timeout=PATIENCE_S, check=False, cwd=tmp_path,
        )  # fmt: skip
        assert done.returncode == 1
        assert said in done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        written = [path for path in folder.rglob("*") if path.is_file()]
        assert {path.name for path in written} >= {"config.yaml", "deploy.log"}
        assert secret not in done.stdout + done.stderr
        assert not [path for path in written if secret.encode() in path.read_bytes()]
