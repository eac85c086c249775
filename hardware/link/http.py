"""HTTP, straight to the device's server."""

import time
from urllib.parse import urlsplit

import httpx

from hardware.errors import LinkError, ProtocolError
from hardware.link.transport import MAX_BODY, Reply, Transport, TransportConfig

__all__ = ["HttpTransport"]


class HttpTransport(Transport):
    """HTTP to a Chi.Bio server, one connection per request (its gunicorn worker closes each one anyway).

    Proxies of the environment are ignored, redirects are not followed, compression is not asked for, and the whole
    answer must come within `read_s`, so that a server that dribbles bytes cannot hold the control loop.

    Args:
      url: http://host:port of the device; speed: device seconds per real second (1 on the bench).
    Raises: ValueError for a malformed address; LinkError, ProtocolError from the calls.
    """

    def __init__(self, url: str, speed: float = 1.0, config: TransportConfig | None = None) -> None:
        config = config or TransportConfig()
        try:
            parts = urlsplit(url)
            valid = parts.scheme in ("http", "https") and parts.hostname and parts.path in ("", "/")
            _ = parts.port
        except ValueError:
            valid = False
        if not valid:
            raise ValueError(f"url = {url!r}: allowed http://host:port, for instance http://192.168.7.2:5000")
        self.url = url.rstrip("/")
        self._read_s = config.timeout(config.read_s, speed)
        self._client = httpx.Client(
            timeout=httpx.Timeout(self._read_s, connect=config.timeout(config.connect_s, speed)),
            limits=httpx.Limits(max_connections=1, max_keepalive_connections=0),
            headers={"X-Requested-With": "XMLHttpRequest", "Accept-Encoding": "identity", "Connection": "close"},
            trust_env=False,
        )

    def close(self) -> None:
        """Close the client. Idempotent."""
        self._client.close()

    def _request(self, method: str, path: str) -> Reply:
        deadline = time.monotonic() + self._read_s
        body = bytearray()
        try:
            with self._client.stream(method, self.url + path) as answer:
                for chunk in answer.iter_raw():
                    body += chunk
                    if len(body) > MAX_BODY:
                        raise ProtocolError(f"{method} {path}: the answer is longer than {MAX_BODY} bytes")
                    if time.monotonic() > deadline:
                        raise LinkError(f"{method} {path}: the answer was not complete after {self._read_s:.1f} s")
                return Reply(answer.status_code, bytes(body), answer.headers.get("date", ""))
        except (httpx.RemoteProtocolError, httpx.DecodingError) as error:
            if "without sending" in str(error):  # closed before the answer was whole: a dying server, not a strange one
                raise LinkError(f"{method} {path}: {self.url} closed the connection without a whole answer") from error
            raise ProtocolError(f"{method} {path}: not an HTTP answer ({error})") from error
        except (httpx.HTTPError, httpx.InvalidURL, OSError) as error:
            reason = str(error) or type(error).__name__
            raise LinkError(f"{method} {path}: no answer from {self.url} ({reason}); check cable and server") from error
