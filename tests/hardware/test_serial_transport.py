"""The serial link over real ptys: driver, a cable that can be cut and disturbed, board agent, emulator."""

import json
import os
import pty
import select
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from hardware.board.board_agent import encode_reply
from hardware.emulator.process import EmulatorProcess
from hardware.errors import LinkError, ProtocolError
from hardware.link import messages
from hardware.link.open import open_transport
from hardware.link.serial import SerialTransport
from hardware.link.transport import Reply, TransportConfig
from tests.patience import PATIENCE_S

AGENT = Path(__file__).parents[2] / "hardware" / "board" / "board_agent.py"
HELLO = b'{"agent": "board_agent", "protocol": 2}'


def config(port: Path, **values: float) -> TransportConfig:
    quick = {"connect_s": 0.3, "read_s": 0.3, "floor_s": 0.1}
    return TransportConfig(kind="serial", port=str(port), **(quick | values))  # type: ignore[arg-type]


class Board:
    """The other end of a pty played by a function: gets (id, method, path), returns the bytes to send."""

    def __init__(self, folder: Path, answer: Callable[[int, str, str], bytes]) -> None:
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = Path(os.ttyname(slave))
        self._slave, self._answer, self.seen = slave, answer, [b""][:0]
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        data = b""
        while not self._end.is_set():
            if not select.select([self.master], [], [], 0.05)[0]:
                continue
            data += os.read(self.master, 4096)
            while b"\n" in data:
                line, _, data = data.partition(b"\n")
                self.seen.append(line)
                number, method, path, _crc = line[1:].decode().split(" ")
                os.write(self.master, self._answer(int(number), method, path))

    def close(self) -> None:
        self._end.set()
        self._thread.join(2.0)
        os.close(self.master)
        os.close(self._slave)


@pytest.fixture
def board(tmp_path: Path) -> Iterator[Callable[..., Board]]:
    opened: list[Board] = []

    def make(answer: Callable[[int, str, str], bytes]) -> Board:
        def greeted(number: int, method: str, path: str) -> bytes:
            return encode_reply(number, 200, HELLO) if method in ("HELLO", "BYE") else answer(number, method, path)

        opened.append(Board(tmp_path, greeted))
        return opened[-1]

    yield make
    for one in opened:
        one.close()


def test_a_request_and_its_reply(board: Callable[..., Board]) -> None:
    b = board(lambda n, m, p: encode_reply(n, 204 if m == "POST" else 200, p.encode()))
    link = SerialTransport(str(b.port), config=config(b.port))
    assert link.hello["agent"] == "board_agent"
    assert link.get("/getSysdata/") == Reply(200, b"/getSysdata/")
    assert link.post("/Experiment/1/M0").status == 204
    link.disarm()
    link.close()
    numbers = [int(line[1:].split(b" ")[0]) for line in b.seen]
    assert [line.split(b" ")[1] for line in b.seen] == [b"HELLO", b"GET", b"POST", b"BYE"]
    assert np.diff(numbers).tolist() == [1, 1, 1]


def test_a_lost_damaged_or_stale_reply_means_the_very_same_line_again(board: Callable[..., Board]) -> None:
    tries = iter(range(10))

    def answer(number: int, method: str, path: str) -> bytes:
        good = encode_reply(number, 204, b"")
        return [good.replace(b"204", b"205"), b"noise\xff\n" + encode_reply(0, 20, b"unreadable"), good][next(tries)]

    b = board(answer)
    link = SerialTransport(str(b.port), config=config(b.port))
    assert link.post("/SetOutputOn/Pump1/1/M0").status == 204
    assert len(set(b.seen[1:])) == 1
    assert len(b.seen) == 4


def test_replies_of_earlier_requests_and_kernel_messages_are_passed_over(board: Callable[..., Board]) -> None:
    b = board(
        lambda n, m, p: b"[  12.3] usb: reset\n" + encode_reply(n - 1, 500, b"old\n<1 2") + encode_reply(n, 204, b"")
    )
    link = SerialTransport(str(b.port), config=config(b.port))
    assert link.post("/MeasureTemp/IR/M0").status == 204


@pytest.mark.parametrize(
    ("status", "error"), [(10, LinkError), (11, LinkError), (12, ProtocolError), (20, ProtocolError)]
)
def test_what_the_agent_could_not_do(board: Callable[..., Board], status: int, error: type[Exception]) -> None:
    b = board(lambda n, m, p: encode_reply(n, status, b"because"))
    link = SerialTransport(str(b.port), config=config(b.port))
    with pytest.raises(error, match="because"):
        link.get("/getSysdata/")


def test_silence_is_a_link_error_and_garbage_a_protocol_error(board: Callable[..., Board]) -> None:
    b = board(lambda n, m, p: b"" if p == "/silent" else encode_reply(n, 200, b"x").replace(b"x", b"y"))
    link = SerialTransport(str(b.port), config=config(b.port))
    with pytest.raises(messages.AgentSilent):
        link.get("/silent")
    with pytest.raises(messages.DamagedFrames):
        link.get("/garbage")


def test_a_foreign_or_newer_peer_is_refused(tmp_path: Path) -> None:
    for body, words in ((b'{"protocol": 3}', "protocol 3"), (b"login:", "not readable"), (b"[1]", "not readable")):
        b = Board(tmp_path, lambda n, m, p, body=body: encode_reply(n, 200, body))  # type: ignore[misc]
        with pytest.raises(ProtocolError, match=words):
            SerialTransport(str(b.port), config=config(b.port))
        b.close()


def test_one_client_per_line_and_no_line_at_all(board: Callable[..., Board], tmp_path: Path) -> None:
    b = board(lambda n, m, p: encode_reply(n, 204, b""))
    link = SerialTransport(str(b.port), config=config(b.port))
    with pytest.raises(LinkError, match="lock"):
        SerialTransport(str(b.port), config=config(b.port))
    link.close()
    SerialTransport(str(b.port), config=config(b.port)).close()
    with pytest.raises(messages.PortNotOpened), open_transport(config(tmp_path / "ttyACM9"), ""):
        pass


class Cable:
    """Two ptys and a relay between them: the PC's port, the board's port, and what can happen to a cable."""

    def __init__(self, folder: Path) -> None:
        self.pc, self.board = folder / "ttyACM0", folder / "ttyGS0"
        self._board_master, self._board_slave = self._pty(self.board)
        self._rng = np.random.default_rng(0)
        self.noise = 0.0  # probability that a chunk is damaged
        self.mode = "pass"  # or what carries nothing
        self._end = threading.Event()
        self._lock = threading.Lock()
        self.plug()
        self._thread = threading.Thread(target=self._relay, daemon=True)
        self._thread.start()

    def set(self, mode: str) -> None:
        self.mode = mode

    @staticmethod
    def _pty(name: Path) -> tuple[int, int]:
        master, slave = pty.openpty()
        tty.setraw(slave)
        name.unlink(missing_ok=True)
        name.symlink_to(os.ttyname(slave))
        return master, slave

    def plug(self) -> None:
        self._pc_master, self._pc_slave = self._pty(self.pc)

    def unplug(self) -> None:
        with self._lock:
            self.pc.unlink()
            os.close(self._pc_master)
            os.close(self._pc_slave)
            self._pc_master = -1

    def _relay(self) -> None:
        while not self._end.is_set():
            with self._lock:
                ends = [self._board_master] + ([self._pc_master] if self._pc_master >= 0 else [])
                for end in select.select(ends, [], [], 0.0)[0]:
                    data = bytearray(os.read(end, 4096))
                    other = self._pc_master if end == self._board_master else self._board_master
                    if data and self._rng.random() < self.noise:
                        data[int(self._rng.integers(len(data)))] ^= 0x15
                    if other >= 0 and self.mode == "pass":
                        os.write(other, data)
            time.sleep(0.002)

    def close(self) -> None:
        self._end.set()
        self._thread.join(2.0)
        for end in (self._board_master, self._board_slave, self._pc_master, self._pc_slave):
            os.close(end)


@pytest.fixture
def cable(tmp_path: Path) -> Iterator[tuple[Cable, EmulatorProcess]]:
    with wired(tmp_path) as both:
        yield both


@contextmanager
def wired(folder: Path, *words: str) -> Iterator[tuple[Cable, EmulatorProcess]]:
    """A cable with an agent and an emulator of two reactors at its end. Args: words: further ones of the emulator."""
    with EmulatorProcess(["--reactors", "M0,M1", "--speed", "60", "--od", "0.5", *words]) as emulator:
        line = Cable(folder)
        log = (folder / "log").open("w")
        agent = subprocess.Popen(
            [sys.executable, str(AGENT), "--tty", str(line.board), "--url", emulator.url, "--deadman", "30"], stderr=log
        )
        try:
            deadline = time.monotonic() + PATIENCE_S
            while " open\n" not in (folder / "log").read_text() and time.monotonic() < deadline:
                time.sleep(0.02)
            yield line, emulator
        finally:
            agent.send_signal(signal.SIGTERM)
            agent.wait(10.0)
            log.close()
            line.close()


def test_on_a_noisy_line_every_request_is_carried_out_exactly_once(cable: tuple[Cable, EmulatorProcess]) -> None:
    line, _ = cable
    link = SerialTransport(str(line.pc), 1.0, config(line.pc, connect_s=10.0, read_s=3.0, floor_s=0.1), attempts=8)
    link.post("/SetOutputTarget/Pump3/M0/0.001")
    line.noise = 0.05
    for k in range(40):
        assert link.post("/SetOutputOn/Pump3/2/M0").status == 204  # a toggle
        assert json.loads(link.get("/getSysdata/").body)["Pump3"]["ON"] == (k + 1) % 2, k
    line.noise = 0.0
    link.close()
