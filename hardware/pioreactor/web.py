"""The vendor's HTTP interface of one unit or leader: replies, and whether a failed request can have been received."""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from http.client import responses
from typing import Any, TypeVar
from urllib.parse import quote

import httpx

from hardware.clock import Clock
from hardware.errors import LinkError, ProtocolError, ReactorError
from hardware.link.http import fetch
from hardware.pioreactor import messages
from hardware.pioreactor.messages import NotHeard

T = TypeVar("T")

PROBE, PROBE_S = "circulate_media", 30.0  # job requested for its help text only; s between two such requests
OVER = ("complete", "succeeded", "failed")  # states of a finished task, in all versions


class Web:
    """`/unit_api` of one unit, for an experiment. `ask` runs requests on a separate thread, one after another."""

    def __init__(self, url: str, experiment: str = "", timeout_s: float = 4.0) -> None:
        self.url, self._timeout_s, self._experiment = url, timeout_s, experiment
        self._env = {"EXPERIMENT": experiment, "JOB_SOURCE": "turbidostat"}
        headers = {"Content-Type": "application/json", "Accept-Encoding": "identity"}
        self._client = httpx.Client(trust_env=False, timeout=timeout_s, headers=headers)
        self._pool = ThreadPoolExecutor(1, thread_name_prefix=f"web {url}")

    def ask(self, what: Callable[..., T], *given: Any) -> "Future[T]":
        """Start one of the calls below on the thread; return its future."""
        return self._pool.submit(what, *given)

    def get(self, path: str, below: str = "/unit_api") -> Any:
        return self.send("GET", path, None, below)

    def run(self, job: str, options: Mapping[str, Any], overrides: Sequence[Sequence[str]] = ()) -> str:
        """Request a job; return the task's id. Raises: as `send`."""
        body = {"options": options, "args": [], "env": self._env, "config_overrides": overrides}
        answer = self.send("POST", f"/jobs/run/job_name/{job}", body)
        if not (isinstance(answer, dict) and isinstance(answer.get("task_id"), str)):
            raise messages.UnknownReply(url=self.url, what=f"answered {str(answer)[:60]} to {job}, expected a task_id")
        return str(answer["task_id"])

    def stop(self, job: str) -> None:
        """Request the end of a job; one version reads the query, another the body. Raises: as `send`."""
        self.send("POST", f"/jobs/stop?job_name={job}", {"job_name": job})

    def set_level(self, level_ml: float) -> str:
        """Set the unit's own ledger of the vial to a volume; return why the unit refuses, or "". Raises: as `send`."""
        path = f"/bioreactor/experiments/{quote(self._experiment, safe='')}"
        try:
            self.send("PATCH", path, {"values": {"current_volume_ml": level_ml}})
        except NotHeard as error:
            if "status" not in error.fields:
                raise
            return str(error)
        return ""

    def astray(self, unit: str) -> str:
        """Return why the leader does not list the unit in this experiment, or "". Raises: LinkError, ProtocolError."""
        try:
            said = self.get(f"/workers/{unit}/experiment", below="/api")
        except NotHeard as error:
            if error.fields.get("status") != 404:
                raise
            return "the leader lists the unit in no experiment"
        if (found := str(said.get("experiment"))) != self._experiment:
            return f"the unit is in the experiment {found}"
        return "" if said.get("is_active", 1) else "the unit is inactive"

    def result(self, task: str) -> bool | None:
        """Return whether a task's process may run; None: the task waits, or its result was read. Raises: as `get`."""
        try:
            answer = self.get(f"/task_results/{task}")
        except ProtocolError as error:
            if error.fields.get("status") == 500:
                return True
            raise
        if not (isinstance(answer, dict) and answer.get("status") in OVER):
            return None
        result = answer.get("result")
        result = result.get("ok") if isinstance(result, dict) else result
        return answer["status"] != "failed" and result is not False

    def running(self) -> list[dict[str, Any]]:
        """Get the vendor's list of running jobs; killed jobs stay in it. Raises: LinkError, ProtocolError."""
        jobs = self.get("/jobs/running")
        if not (isinstance(jobs, list) and all(isinstance(job, dict) and "job_name" in job for job in jobs)):
            raise messages.UnknownReply(url=self.url, what=f"{str(jobs)[:60]} is no list of jobs")
        return jobs

    def send(self, method: str, path: str, body: Mapping[str, Any] | None, below: str = "/unit_api") -> Any:
        """Send a request. Raises: NotHeard if it was certainly not carried out; another ReactorError if it may be."""
        url, content = f"{self.url}{below}{path}", None if body is None else json.dumps(body).encode()
        try:
            status, said, _ = fetch(self._client, method, url, self._timeout_s, content)
        except LinkError as error:
            nobody = isinstance(error.__cause__, httpx.ConnectError | httpx.ConnectTimeout)
            said_so = messages.NobodyReached if nobody else messages.NoReply  # with this family's remedy
            raise said_so(error=error.sentence) from error
        try:
            answer = json.loads(said or b"null")
        except (ValueError, RecursionError):
            answer = said[:400].decode("utf-8", "replace")
            if status < 300:
                raise messages.UnknownReply(url=url, what=f"not JSON: {answer[:60]!r}") from None
        if status < 300:
            return answer
        reason = answer.get("error", answer) if isinstance(answer, dict) else answer
        if str(reason).lstrip().startswith("<"):  # a web page
            reason = responses.get(status, "a page")
        failed = messages.TurnedAway if 400 <= status < 500 else messages.ServerFailed
        raise failed(url=url, status=status, reason=" ".join(str(reason).split())[:160])

    def close(self) -> None:
        """Close the connection; a request that hangs ends by its time-out. Idempotent."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._client.close()


class Calls:
    """HTTP requests without waiting: one of each kind at a time, at a limited rate.

    Attributes: failed: for each kind whose last request failed, the time of the first failure and the last error.
    """

    def __init__(self, web: Web, clock: Clock) -> None:
        self._web, self._clock = web, clock
        self._open: dict[str, Future[Any]] = {}
        self._next: dict[str, float] = {}
        self.failed: dict[str, tuple[float, str]] = {}

    def due(self, kind: str, every_s: float) -> bool:
        if due := self._clock.now() >= self._next.get(kind, -math.inf):
            self._next[kind] = self._clock.now() + every_s
        return due

    def ask(self, kind: str, every_s: float, what: Callable[..., T], *given: Any) -> tuple[T] | None:
        """Send a request if it is due; return an answer that came since the last call; None if none, or an error."""
        if kind not in self._open and self.due(kind, every_s):
            self._open[kind] = self._web.ask(what, *given)
        if kind in self._open and self._open[kind].done():
            since_s, _ = self.failed.pop(kind, (self._clock.now(), ""))
            try:
                return (self._open.pop(kind).result(),)
            except ReactorError as error:
                self.failed[kind] = since_s, str(error)
        return None


class Barrier:
    """Test that no older request waits in the task queue: a harmless request, sent after it, was processed."""

    def __init__(self, web: Web, clock: Clock, wait_s: float = 0.0) -> None:
        self._calls, self._web, self._task = Calls(web, clock), web, ""
        self._clock, self._from_s, self._passed = clock, clock.now() + wait_s, False

    def passed(self) -> bool:
        if self._clock.now() < self._from_s or self._passed:
            return self._passed
        said = self._calls.ask("result", 0.5, self._web.result, self._task) if self._task else None
        self._passed = bool(said and said[0] is not None)
        if made := self._calls.ask("run", PROBE_S, self._web.run, PROBE, {"help": None}):
            self._task = made[0]
        return self._passed
