"""One client per device, by whatever name or link it is reached; a device or cable that is gone is told at once."""

import json
import os
import threading
import time
import urllib.request
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest

from hardware.chibio.config import ChiBioConfig
from hardware.chibio.family import linked
from hardware.chibio.messages import WrongStatus
from hardware.emulator.process import EmulatorProcess
from hardware.errors import LinkError
from hardware.link.messages import DeviceTaken
from hardware.link.serial import SerialTransport
from tests.hardware.test_serial_transport import Cable, cable, config  # noqa: F401  (cable is a fixture)
from tests.programs import Program, run


def test_a_second_master_is_refused_under_another_name_of_the_device(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with EmulatorProcess(["--speed", "100", "--reactors", "M1,M2"]) as device:
        by_number = ChiBioConfig(url=device.url, speed=100.0, reactors=("M1",))
        by_name = ChiBioConfig(url=device.url.replace("127.0.0.1", "localhost"), speed=100.0, reactors=("M2",))
        refusal = pytest.raises(DeviceTaken, match=f"process {os.getpid()}")
        with linked(by_number), refusal:
            monkeypatch.setattr("tempfile.tempdir", str(tmp_path))  # as of another user
            linked(by_name).__enter__()
        with linked(by_name):
            pass


def test_two_devices_may_have_a_master_each() -> None:
    with (
        EmulatorProcess(["--speed", "100"]) as one,
        EmulatorProcess(["--speed", "100"]) as other,
        linked(ChiBioConfig(url=one.url, speed=100.0)),
        linked(ChiBioConfig(url=other.url, speed=100.0)),
    ):
        pass


def test_a_server_that_is_another_one_is_told_by_its_address() -> None:
    with HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as other:  # which answers 501 to every GET
        threading.Thread(target=other.serve_forever, daemon=True).start()
        url = f"http://127.0.0.1:{other.server_port}"
        with pytest.raises(WrongStatus) as error, linked(ChiBioConfig(url=url)):
            pass
        assert error.value.fields == {"request": f"{url}: GET /getSysdata/", "status": 501, "expected": 200}
        other.shutdown()


@pytest.mark.parametrize("command", ["blank", "deploy"])
def test_a_wrong_address_is_one_line_and_speaks_of_no_pumps(tmp_path: Path, command: str) -> None:
    words = ["backend.url=http://127.0.0.1:9", *(["backend=chibio", "controller=pi"] if command == "deploy" else [])]
    done = run(f"experiments.{command}", *words, cwd=tmp_path)
    said = (done.stdout + done.stderr).splitlines()
    assert done.returncode == 1
    assert "http://127.0.0.1:9" in said[-1]
    assert not any("Traceback" in line or "not verified off" in line or "by hand" in line for line in said)


@pytest.mark.slow
def test_a_service_manager_that_ends_a_blank_leaves_its_pumps_off(tmp_path: Path) -> None:
    """By SIGTERM, and by a second one at once."""
    with EmulatorProcess(["--speed", "20", "--od", "0", "--unblanked"]) as device:
        words = [f"backend.url={device.url}", "backend.speed=20", f"backend.calibration={tmp_path}/c"]
        words.append("hydra.run.dir=run")
        client = Program("experiments.blank", *words, cwd=tmp_path, out=tmp_path / "out")
        client.until(lambda: "waiting for" in client.said())
        for path in ("SetOutputTarget/Pump1/M0/0.05", "SetOutputOn/Pump1/1/M0"):  # by somebody else's hand
            request = urllib.request.Request(f"{device.url}/{path}", method="POST")
            urllib.request.urlopen(request, timeout=10.0).close()
        client.terminate()
        time.sleep(0.02)
        client.terminate()
        status, said = client.end()
        with urllib.request.urlopen(f"{device.url}/getSysdata/", timeout=10.0) as answer:
            assert json.load(answer)["Pump1"]["ON"] == 0
    assert status == 130
    assert "Traceback" not in said


TOGGLE = "/SetOutputOn/Pump3/2/M0"


def test_a_line_that_was_unplugged_is_reopened_and_carries_out_nothing_twice(
    cable: tuple[Cable, EmulatorProcess],  # noqa: F811
) -> None:
    line, _ = cable
    link = SerialTransport(str(line.pc), 60.0, config(line.pc, floor_s=2.0))  # a busy machine may be late
    link.post("/SetOutputTarget/Pump3/M0/0.001")
    for k in range(1, 4):
        assert link.post(TOGGLE).status == 204
        line.unplug()
        for _ in range(2):
            with pytest.raises(LinkError):
                link.post(TOGGLE)
        line.plug()
        assert json.loads(link.get("/getSysdata/").body)["Pump3"]["ON"] == k % 2
    link.close()
