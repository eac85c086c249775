"""The whole serial link: driver's transport, two ptys with a noisy cable between them, board agent, emulator."""

import json
import os
import pty
import random
import select
import subprocess
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from hardware.chibio.protocol import parse_state
from hardware.errors import LinkError
from hardware.link.serial import SerialTransport
from hardware.link.transport import TransportConfig
from tests.hardware.test_board_agent import PYTHON, SOURCE, AgentLab
from tests.hardware.test_emulator_server import Process


class Cable:
    """Two ttys and what carries bytes between them; `damage` is the probability that a chunk gets a wrong byte."""

    def __init__(self, board: Path, pc: Path) -> None:
        self.paths = (board, pc)
        self.damage = 0.0
        self._rng = random.Random(1)
        self._ends: list[tuple[int, int]] = []
        self.plug()

    def plug(self) -> None:
        self._ends = []
        for path in self.paths:
            master, slave = pty.openpty()
            tty.setraw(slave)
            path.unlink(missing_ok=True)
            path.symlink_to(os.ttyname(slave))
            self._ends.append((master, slave))
        self._quit, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        os.write(self._wake, b"x")
        self._thread.join()
        for path, ends in zip(self.paths, self._ends, strict=True):
            path.unlink()
            for descriptor in ends:
                os.close(descriptor)
        os.close(self._quit)
        os.close(self._wake)

    def _carry(self) -> None:
        board, pc = (master for master, _ in self._ends)
        while True:
            ready = select.select([board, pc, self._quit], [], [])[0]
            if self._quit in ready:
                return
            for source in ready:
                data = bytearray(os.read(source, 64))
                if self._rng.random() < self.damage:
                    data[self._rng.randrange(len(data))] ^= 1 << self._rng.randrange(8)
                os.write(pc if source == board else board, data)


class Link:
    """Everything from the emulator to the PC's end of the line."""

    def __init__(self, folder: Path) -> None:
        self.emulator = Process("--reactors", "M0,M1", "--speed", "60")
        self.cable = Cable(folder / "board", folder / "pc")
        command = [PYTHON, str(SOURCE), "--tty", str(folder / "board"), "--http-timeout", "1"]
        log = folder / "log"
        with log.open("w") as stderr:
            self.agent = subprocess.Popen([*command, "--url", f"http://127.0.0.1:{self.emulator.port}"], stderr=stderr)
        AgentLab.until(lambda: " open\n" in log.read_text())
        config = TransportConfig(kind="serial", port=str(folder / "pc"), connect_s=0.5, read_s=1.5, floor_s=0.1)
        self.transport = SerialTransport(str(folder / "pc"), 1.0, config, attempts=8)

    def end(self) -> None:
        self.transport.close()
        self.agent.terminate()
        assert self.agent.wait(timeout=10) == 0
        self.emulator.end()
        self.cable.unplug()


@pytest.fixture
def link(tmp_path: Path) -> Iterator[Link]:
    one = Link(tmp_path)
    yield one
    one.end()


def test_the_driver_reads_a_reduced_state(link: Link) -> None:
    assert link.transport.hello["deadman_s"] == 120.0
    assert link.transport.post("/changeDevice/M1").status == 204
    reply = link.transport.get("/getSysdata/")
    assert len(reply.body) < 1024
    state = parse_state(reply.body)
    assert (state.selected, state.present, state.running) == ("M1", ("M0", "M1"), False)


def test_on_a_noisy_line_every_request_is_carried_out_exactly_once(link: Link) -> None:
    link.transport.post("/SetOutputTarget/Pump3/M0/0.001")
    link.cable.damage = 0.03
    for k in range(60):
        assert link.transport.post("/SetOutputOn/Pump3/2/M0").status == 204  # a toggle
        on = json.loads(link.transport.get("/getSysdata/").body)["Pump3"]["ON"]
        assert on == (k + 1) % 2, k
    link.cable.damage = 0.0


def test_pulled_and_plugged_again(link: Link) -> None:
    for _ in range(2):
        link.cable.unplug()
        with pytest.raises(LinkError):
            link.transport.get("/getSysdata/")
        link.cable.plug()

        def answers() -> bool:
            try:
                return link.transport.get("/getSysdata/").status == 200
            except LinkError:
                return False

        AgentLab.until(answers, timeout=15.0)
