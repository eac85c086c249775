"""A stub of an eVOLVER: sixteen first-order cultures behind one small HTTP server, in device time.

Its time passes only while a client waits for a sample, so a run takes as long as its requests.

  GET /sample?after=K    the first sample later than number K: {"k", "t", "od": [16], "celsius": [16], "raw": [16]}
  POST /dose {"id", "ml": {vial: mL}}    medium into vials, the same efflux out of them; an id is given once
  GET /dose?id=ID        what that dose gave, {} if it never came
  POST /off {"vials"}    their pumps off; answers {"running": [vial]}
  POST /heat {"vial", "celsius"}
"""

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

__all__ = ["VIALS", "EvolverStub"]

VIALS = 16
PERIOD_S, GROWTH_PER_MIN, VOLUME_ML = 60.0, 0.02, 20.0


class EvolverStub:
    """The device; use as a context manager.

    Attributes: url; fed_ml, what each vial really got, (16,); stuck, vials whose pumps do not stop; hold_at, the id of
      a dose that is given and not answered: `held` is set then, and the answer comes when `go` is.
    """

    def __init__(self, od: float = 0.5) -> None:
        rng = np.random.default_rng(0)
        self.od, self.celsius = od * np.exp(rng.normal(0.0, 0.05, VIALS)), np.full(VIALS, 37.0)
        self.fed_ml, self.doses = np.zeros(VIALS), dict[str, dict[str, float]]()
        self.k, self.stuck = 0, set[int]()
        self.hold_at, self.held, self.go = "", threading.Event(), threading.Event()
        self._rng, self._turn = rng, threading.Lock()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"device": self}))
        self.url = f"http://127.0.0.1:{self._server.server_port}"

    def sample(self, after: int) -> dict[str, Any]:
        """Let time pass until there is a later sample."""
        while self.k <= after:
            self.k += 1
            self.od = self.od * np.exp(GROWTH_PER_MIN * PERIOD_S / 60.0)
        read = self.od * (1.0 + self._rng.normal(0.0, 0.003, VIALS))
        raw = 60000.0 * np.exp(-read)
        found = {"od": read.tolist(), "celsius": self.celsius.tolist(), "raw": raw.tolist()}
        return {"k": self.k, "t": PERIOD_S * self.k, **found}

    def dose(self, number: str, ml: dict[str, float]) -> dict[str, Any]:
        """Give it once."""
        if number not in self.doses:
            self.doses[number] = ml
            for vial, volume in ml.items():
                self.fed_ml[int(vial)] += volume
                self.od[int(vial)] *= VOLUME_ML / (VOLUME_ML + volume)
        if number == self.hold_at:
            self.held.set()
            self.go.wait(60.0)
        return {}

    def answer(self, path: str, values: dict[str, Any]) -> dict[str, Any]:
        """One request."""
        with self._turn:
            if path == "/sample":
                return self.sample(int(values["after"]))
            if path == "/dose":
                return self.dose(values["id"], values["ml"]) if "ml" in values else self.doses.get(values["id"], {})
            if path == "/heat":
                self.celsius[int(values["vial"])] = float(values["celsius"])
                return {}
            return {"running": sorted(self.stuck & set(values["vials"]))}

    def __enter__(self) -> "EvolverStub":
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()
        return self

    def __exit__(self, *_raised: object) -> None:
        self.go.set()
        self._server.shutdown()
        self._server.server_close()


class _Handler(BaseHTTPRequestHandler):
    device: EvolverStub

    def do_GET(self) -> None:
        url = urlsplit(self.path)
        self._answer(url.path, {key: values[0] for key, values in parse_qs(url.query).items()})

    def do_POST(self) -> None:
        self._answer(self.path, json.loads(self.rfile.read(int(self.headers["Content-Length"]))))

    def _answer(self, path: str, values: dict[str, Any]) -> None:
        body = json.dumps(self.device.answer(path, values)).encode()
        try:
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
        except OSError:  # whoever asked was killed
            pass

    def log_message(self, format: str, *args: Any) -> None:
        pass
