"""One client per unit, on whatever computer: said at the broker, and cleared by it when the client is gone."""

import multiprocessing
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hardware.clock import RealClock
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.mailbox import Cluster, Mailbox
from hardware.pioreactor.messages import OtherClient, UnitTaken
from hardware.rig.build import broker
from hardware.rig.processes import _free_port
from tests.hardware.pioreactor_lab import UNIT, Lab
from tests.hardware.test_emulator_server import until

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
