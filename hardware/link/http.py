"""HTTP to the device's server or its board agent."""

import contextlib
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any
from urllib.parse import urlsplit

import httpx

from hardware.clock import DeviceClock
from hardware.errors import ReactorError
from hardware.link import messages, transport
from hardware.link.transport import MAX_BODY, Reply, SwitchedOff, Transport, TransportConfig, new_session

AGENT = "board_agent/"  # start of the server's name in answers of a board agent
REFUSED = (401, 403, 409)  # statuses of requests that the agent did not carry out
STOPS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GRACE_S = 0.2  # without any answer the client's own time-out comes first, because its error says more
TOKEN = "give backend.transport.token_file a copy of the board's (docs/board_agent.md, The token)"


@contextlib.contextmanager
def _cut_after(wait_s: float) -> Iterator[Callable[[str, dict[str, Any]], None]]:
    """Cut a request off after `wait_s` or at a stop; httpx's own time-out restarts with every byte.

    The exception of a signal handler is raised after the request. During the request it would leave a lock or the
    connection's slot taken for ever, and then no pump could be switched off.
    """
    opened: list[socket.socket] = []
    came: list[BaseException] = []
    under_way = True

    def trace(event: str, info: dict[str, Any]) -> None:
        if event.endswith(("connect_tcp.complete", "start_tls.complete")):
            opened[:] = [info["return_value"].get_extra_info("socket")]
            if came:
                cut()

    def cut() -> None:
        for one in opened:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def stop(number: int, stack: FrameType | None) -> None:
        try:
            before[number](number, stack)
        except BaseException as raised:
            if not under_way:  # it came while the handlers were put back
                raise
            came.append(raised)
            cut()

    main = threading.current_thread() is threading.main_thread()
    before = {int(n): old for n in STOPS if main and callable(old := signal.getsignal(n))}
    late = threading.Timer(wait_s, cut)
    late.daemon = True
    try:
        for number in before:
            signal.signal(number, stop)
        late.start()
        yield trace
    finally:
        under_way = False
        late.cancel()
        for number, old in before.items():
            signal.signal(number, old)
        if came:
            raise came.pop()


def fetch(
    client: httpx.Client, method: str, url: str, wait_s: float, body: bytes | None = None
) -> tuple[int, bytes, httpx.Headers]:
    """Return status, body and headers of a reply; fail unless the whole reply arrives within `wait_s`.

    Raises: LinkError, with cause httpx.ConnectError or ConnectTimeout if the host was not reached; ProtocolError.
    """
    what, deadline, found = f"{method} {urlsplit(url).path}", time.monotonic() + wait_s, bytearray()
    try:
        with (
            _cut_after(wait_s + GRACE_S) as trace,
            client.stream(method, url, content=body, extensions={"trace": trace}) as answer,
        ):
            for chunk in answer.iter_raw():
                found += chunk
                if len(found) > MAX_BODY:
                    raise messages.TooLong(request=what, most=MAX_BODY)
                if time.monotonic() > deadline:
                    raise messages.NotComplete(request=what, seconds=wait_s)
            return answer.status_code, bytes(found), answer.headers
    except (httpx.RemoteProtocolError, httpx.DecodingError) as error:
        if time.monotonic() > deadline:
            raise messages.NotComplete(request=what, seconds=wait_s) from error
        if "without sending" in str(error):  # the server ended before the answer was complete
            raise messages.CutOff(request=what, url=url) from error
        raise messages.NotHttp(request=what, why=error) from error
    except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
        reason, host = str(error) or type(error).__name__, url.removesuffix(urlsplit(url).path)
        reached = isinstance(error, (httpx.ReadTimeout, httpx.ReadError))
        failed = messages.NotAnswered if reached else messages.NotReached
        raise failed(request=what, host=host, why=reason) from error


class HttpTransport(Transport):
    """HTTP to a Chi.Bio server or its board agent; one connection per request, because the server closes each.

    Proxies of the environment are ignored, redirects are not followed, and compression is not requested. The whole
    answer must come within `read_s`, so that a slow server cannot hold the control loop.
    Args: speed: device seconds per real second. session: number by which a board agent recognizes this client.
    Raises: ValueError for a malformed address; LinkError for an unusable token file; LinkError, ProtocolError in calls.
    """

    def __init__(
        self, url: str, speed: float = 1.0, config: TransportConfig | None = None, session: int | None = None
    ) -> None:
        config = config or TransportConfig()
        transport.require_web_address("url", url)
        self.url = url.rstrip("/")
        self._clock = DeviceClock(speed)
        self._read_s = config.timeout(config.read_s, self._clock)
        self._token = transport.read_secret("token_file", config.token_file, 32, TOKEN) if config.token_file else ""
        authority = {"Authorization": f"Bearer {self._token}", "X-Session": str(session or new_session())}
        self._client = httpx.Client(
            timeout=httpx.Timeout(self._read_s, connect=config.timeout(config.connect_s, self._clock)),
            limits=httpx.Limits(max_keepalive_connections=0),
            headers={"X-Requested-With": "XMLHttpRequest", "Accept-Encoding": "identity", "Connection": "close"}
            | (authority if self._token else {}),
            trust_env=False,
        )

    def disarm(self) -> None:
        if self._token:
            with contextlib.suppress(ReactorError):
                self.post("/_agent/bye")

    def switched_off(self) -> SwitchedOff:
        return transport.switched_off(self.get("/_agent/status").body, self._clock) if self._token else {}

    def close(self) -> None:
        self._client.close()

    def _request(self, method: str, path: str) -> Reply:
        status, body, headers = fetch(self._client, method, self.url + path, self._read_s)
        if status in REFUSED and headers.get("server", "").startswith(AGENT):
            why = body[:300].decode("ascii", "replace").strip()
            raise messages.AgentRefuses(request=f"{method} {path}", why=why)
        return Reply(status, body, headers.get("date", ""))
