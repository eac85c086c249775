"""The cable between a client and a device: real sockets that can be pulled, slowed, and listened to."""

from __future__ import annotations

import contextlib
import re
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

MODES = ("pass", "refuse", "hole", "mute", "reset", "dribble")
ANSWER = b"HTTP/1.1 204 NO CONTENT\r\nConnection: close\r\n\r\n"


@dataclass
class Rule:
    """What befalls requests whose "METHOD /path" matches. Times in device seconds.

    before: wait before the device hears it; after: before the client hears the answer; times: how often, None for
    always; swallow: answered 204, never heard by the device; keeps: each answer is that to the first; then: called when
    the device has answered and the client does not know yet, `ahead` before the device hears it.
    """

    pattern: str
    before: float = 0.0
    after: float = 0.0
    times: int | None = None
    swallow: bool = False
    keeps: bool = False
    kept: bytes = b""
    ahead: Callable[[], None] | None = None
    then: Callable[[], None] | None = None


@dataclass
class Link:
    """A proxy in front of `target` (http://host:port). speed: device per real second.

    set("refuse") closes the port, "hole" swallows what is sent and every new connection, as a pulled cable does;
    "mute" accepts and never answers; "reset" accepts and resets; "dribble" sends a byte each 0.2 real seconds.
    """

    target: str
    speed: float
    mode: str = "pass"
    rules: list[Rule] = field(default_factory=list)

    def __post_init__(self) -> None:
        host, port = self.target.removeprefix("http://").split(":")
        self._to, self._lock = (host, int(port)), threading.Lock()
        self._listener, self._fillers, self._epoch = self._listen(0, 64), list[socket.socket](), 0
        self.port = self._listener.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self._closed = False
        threading.Thread(target=self._accept, daemon=True).start()

    @staticmethod
    def _listen(port: int, backlog: int) -> socket.socket:
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        for attempt in range(200):
            try:
                listener.bind(("127.0.0.1", port))
                break
            except OSError:  # the thread that accepts still looks at the listener before
                if attempt == 199:
                    raise
                time.sleep(0.005)
        listener.listen(backlog)
        return listener

    def set(self, mode: str) -> None:
        """Change what the cable does, also to requests on their way."""
        assert mode in MODES
        with self._lock:
            was, self.mode = self.mode, mode
            self._epoch += 1
            if {was, mode} & {"refuse", "hole"} and was != mode:
                for end in (self._listener, *self._fillers):
                    end.close()
                self._fillers = []
                if mode == "hole":  # a full queue: the kernel drops every further SYN
                    self._listener = self._listen(self.port, 0)
                    for _ in range(2):
                        filler = socket.socket()
                        filler.setblocking(False)
                        filler.connect_ex(("127.0.0.1", self.port))
                        self._fillers.append(filler)
                elif mode != "refuse":
                    self._listener = self._listen(self.port, 64)

    def close(self) -> None:
        self._closed = True
        self.set("refuse")

    def _accept(self) -> None:
        while not self._closed:
            listener, mode = self._listener, self.mode
            if mode in ("refuse", "hole"):
                time.sleep(0.005)
                continue
            try:
                if select.select([listener], [], [], 0.02)[0] and self.mode == mode:
                    connection, _ = listener.accept()
                    threading.Thread(target=self._serve, args=(connection,), daemon=True).start()
            except (OSError, ValueError):
                time.sleep(0.005)

    def _serve(self, client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
            while self._one(client):
                pass

    def _one(self, client: socket.socket) -> bool:
        """One request and its answer. Returns whether another may follow on this connection."""
        head = b""
        while b"\r\n\r\n" not in head:
            more = client.recv(65536)
            if not more:
                return False
            head += more
        epoch = self._epoch
        request = " ".join(head.split(b"\r\n", 1)[0].decode("latin1").split(" ")[:2])
        rules = [r for r in self.rules if r.times != 0 and re.search(r.pattern, request)]
        for rule in rules:
            rule.times = None if rule.times is None else rule.times - 1
            if rule.ahead:
                rule.ahead()
            self._wait(rule.before)
        if self._lost(client, epoch):
            return False
        kept = next((rule.kept for rule in rules if rule.kept), b"")
        answer = ANSWER if any(rule.swallow for rule in rules) else kept or self._forward(head)
        for rule in rules:
            rule.kept = answer if rule.keeps else b""
        for rule in rules:
            self._wait(rule.after)
            if rule.then:
                rule.then()
        if not answer or self._lost(client, epoch):
            return False
        for piece in [answer[k : k + 1] for k in range(len(answer))] if self.mode == "dribble" else [answer]:
            if self.mode == "dribble":
                time.sleep(0.2)
            client.sendall(piece)
        return b"connection: close" not in answer.split(b"\r\n\r\n")[0].lower()

    def _wait(self, seconds: float) -> None:
        time.sleep(seconds / self.speed)

    def _lost(self, client: socket.socket, epoch: int) -> bool:
        """Whether the cable keeps this request or answer; silent cables hold the connection until they are mended."""
        if self.mode == "reset":
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            return True
        if epoch == self._epoch and self.mode in ("pass", "dribble"):
            return False
        while self.mode in ("hole", "mute") and not self._closed:
            time.sleep(0.02)
        return True

    def _forward(self, head: bytes) -> bytes:
        try:
            with socket.create_connection(self._to, timeout=60.0) as device:
                device.sendall(head)
                answer = b""
                while more := device.recv(65536):
                    answer += more
                    top, end, body = answer.partition(b"\r\n\r\n")
                    length = re.search(rb"content-length: *(\d+)", top, re.IGNORECASE)
                    if end and (b" 204 " in top or (length and len(body) >= int(length[1]))):
                        break
                return answer
        except OSError:
            return b""
