"""Where the driver meets a Pioreactor: web server, broker and its password, the lock of one client on a unit."""

import getpass
import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from hardware.clock import RealClock
from hardware.errors import LinkError, ProtocolError
from hardware.pioreactor.config import PASSWORD, PioreactorConfig
from hardware.pioreactor.mailbox import Cluster, Mailbox
from hardware.pioreactor.messages import NoReply, NotHeard, OtherClient, ServerFailed, UnitTaken
from hardware.pioreactor.reactors import PioreactorReactors
from hardware.pioreactor.web import Web
from hardware.rig.build import broker
from hardware.rig.processes import _free_port
from tests.hardware.pioreactor_lab import UNIT, Lab
from tests.hardware.test_emulator_server import until
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
def guarded(tmp_path: Path) -> Iterator[int]:
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
def test_a_password_comes_from_the_environment_or_a_file_that_only_its_owner_reads(guarded, tmp_path, monkeypatch):
    monkeypatch.delenv(PASSWORD, raising=False)
    with pytest.raises(LinkError, match=r"Not authorized.*backend.password_file or the environment"):
        connected(guarded)
    monkeypatch.setenv(PASSWORD, "zebra-77")
    assert connected(guarded)
    monkeypatch.setenv(PASSWORD, "wrong")
    file = tmp_path / "password"
    file.write_text("zebra-77\n")
    file.chmod(0o600)
    assert connected(guarded, password_file=str(file))
    file.chmod(0o644)
    with pytest.raises(LinkError, match=r"backend.password_file = .*mode 644.*chmod 600") as found:
        connected(guarded, password_file=str(file))
    assert "zebra" not in str(found.value)
    with pytest.raises(LinkError, match=r"backend.password_file = .*No such file"):
        connected(guarded, password_file=str(tmp_path / "none"))


@pytest.mark.slow
def test_a_password_stands_in_no_file_of_a_run_and_a_refusal_is_a_line_of_the_preflight(guarded, tmp_path):
    given = [f"backend.broker_port={guarded}", "backend.broker=127.0.0.1", "backend.username=ada"]
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


HELD = OtherClient(pid=7, host="elsewhere", unit=UNIT, topic="lock")


@contextmanager
def real_broker(folder: Path, settings: str) -> Iterator[int]:
    """A broker of one's own with these lines of mosquitto.conf; its port."""
    pytest.importorskip("paho.mqtt.client", reason="pip install 'paho-mqtt>=2'")
    if (program := broker()) is None:
        pytest.skip("no MQTT broker: apt-get install mosquitto")
    conf, log = folder / "mosquitto.conf", folder / "log"
    for _ in range(20):  # a port that is free now may be another program's a moment later: that broker ends itself
        number = _free_port()
        conf.write_text(f"listener {number} 127.0.0.1\n{settings}\n", encoding="utf-8")
        with log.open("wb") as out, subprocess.Popen([program, "-c", conf], stdout=out, stderr=out) as process:
            try:
                assert until(lambda: process.poll() is not None or b" running" in log.read_bytes())
                if process.poll() is None:
                    yield number
                    return
            finally:
                process.kill()
    pytest.fail(log.read_text())


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    with real_broker(tmp_path, "allow_anonymous true") as number:
        yield number


def client(port: int, name: str, *units: str) -> Cluster:
    clock = RealClock()
    config = PioreactorConfig(reactors=units, broker="127.0.0.1", broker_port=port)
    made = Cluster(config, {unit: Mailbox(unit, config, clock) for unit in units}, name, clock)
    assert until(lambda: made.connected)
    return made


def killed_client(port: int) -> None:
    client(port, "run1", "pio01").hold()
    time.sleep(600.0)


@contextmanager
def killable(port: int) -> Iterator[int]:
    """The process of a client that holds a unit; killed at the end."""
    process = multiprocessing.get_context("spawn").Process(target=killed_client, args=(port,))
    process.start()
    try:
        assert process.pid is not None
        yield process.pid
    finally:
        process.kill()
        process.join()


def held(cluster: Any) -> str:
    """By which process the first unit is."""
    other = cluster.holder("pio01")
    return str(other.fields["pid"]) if other else ""


@pytest.mark.slow
def test_a_unit_is_held_until_its_client_leaves_or_dies_and_its_own_run_may_come_back(port: int) -> None:
    other = client(port, "run2", "pio01", "pio02")
    first = client(port, "run1", "pio01")
    first.hold()
    assert until(lambda: held(other) == str(os.getpid()))
    assert other.holder("pio02") is first.holder("pio01") is None
    first.close()
    assert until(lambda: other.holder("pio01") is None)
    with killable(port) as pid:
        assert until(lambda: held(other) == str(pid))
        late = client(port, "run3", "pio01")
        assert until(lambda: late.holder("pio01") is not None)  # it is retained
        late.close()
    assert until(lambda: other.holder("pio01") is None)
    with killable(port) as pid:
        assert until(lambda: held(other) == str(pid))
        os.kill(pid, signal.SIGSTOP)  # gone, and the broker still believes in it
        again = client(port, "run1", "pio01")
        again.hold()
        assert until(lambda: held(other) == str(os.getpid()))
        assert again.holder("pio01") is None
        again.close()
    other.close()


@pytest.mark.slow
def test_a_connection_that_was_lost_holds_its_units_again(port: int) -> None:
    other, first = client(port, "run2", "pio01"), client(port, "run1", "pio01")
    first.hold()
    assert until(lambda: other.holder("pio01") is not None)
    first._client.socket().shutdown(2)  # the broker sends the last will
    assert until(lambda: first.broke_s > 0.0 and first.connected)
    assert "closed" in first.lost
    assert until(lambda: other.holder("pio01") is not None)
    first.close()
    other.close()


def test_a_unit_of_another_client_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab(monkeypatch)
    lab.world.holder = HELD
    with pytest.raises(UnitTaken):
        lab.begin()
    assert not lab.world.asked


def test_a_second_client_in_the_run_holds_our_doses(monkeypatch: pytest.MonkeyPatch) -> None:
    lab = Lab(monkeypatch)
    lab.begin()
    assert lab.world.mqtt.held
    lab.sample()
    lab.world.holder = HELD
    lab.wait(1.0)
    assert (lab.fault.kind, lab.fault.fields["unit"]) == ("mode", UNIT)
    assert lab.dose(0.5) == 0.0
    assert not lab.asked("add_media")
