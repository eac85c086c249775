"""The vendor's HTTP interface of one unit: what was said, and whether it can have been heard."""

import json
import time
import urllib.error
import urllib.request
from datetime import datetime
from typing import Any

from hardware.errors import LinkError, ProtocolError

__all__ = ["NotHeard", "Web"]


class NotHeard(LinkError):
    """A request that certainly was not carried out: nobody listened, or it was turned away."""


class Web:
    """`/unit_api` of one unit. Args: url: e.g. http://pio01.local. timeout_s: of one request."""

    def __init__(self, url: str, timeout_s: float = 4.0) -> None:
        self.url, self._timeout_s = url, timeout_s

    def get(self, path: str) -> Any:
        """The answer's content. Raises: LinkError, ProtocolError."""
        return self._request("GET", path, None)

    def post(self, path: str, body: dict[str, Any] | None = None) -> Any:
        """The answer's content; 202 says only that it was written down.

        Raises: NotHeard when it cannot have been carried out; other LinkError and ProtocolError when that is unknown.
        """
        return self._request("POST", path, body or {})

    def run(self, job: str, options: dict[str, Any], env: dict[str, str], overrides: list[list[str]]) -> str:
        """Ask for a job; returns the task's id. Raises: as `post`."""
        body = {"options": options, "args": [], "env": env, "config_overrides": overrides}
        answer = self.post(f"/jobs/run/job_name/{job}", body)
        if not (isinstance(answer, dict) and isinstance(answer.get("task_id"), str)):
            raise ProtocolError(f"{self.url}: answered {str(answer)[:60]} to {job}, expected a task_id")
        return str(answer["task_id"])

    def result(self, task: str) -> bool | None:
        """Whether the process that a task began may be there; False: it was over within half a second; None: it waits.

        An answer is given once: a second question is answered as if it still waited. A task that failed may have begun
        its process. Raises: LinkError, ProtocolError.
        """
        try:
            answer = self.get(f"/task_results/{task}")
        except ProtocolError as error:
            if "status 500" in str(error):
                return True
            raise
        done = isinstance(answer, dict) and answer.get("status") == "complete"
        return bool(answer["result"]) if done else None

    def running(self) -> list[dict[str, Any]]:
        """The vendor's list of running jobs; one whose process was killed is in it for ever.

        Raises: LinkError, ProtocolError.
        """
        jobs = self.get("/jobs/running")
        if not (isinstance(jobs, list) and all(isinstance(job, dict) and "job_name" in job for job in jobs)):
            raise ProtocolError(f"{self.url}: {str(jobs)[:60]} is no list of jobs")
        return jobs

    def clock_error_s(self) -> float:
        """The unit's clock minus ours, s. Raises: ReactorError."""
        said = str(self.get("/health").get("utc_time", ""))
        try:
            return datetime.fromisoformat(said.replace("Z", "+00:00")).timestamp() - time.time()
        except ValueError:
            raise LinkError(f"{self.url}: {said!r} is no time") from None

    def _request(self, method: str, path: str, body: dict[str, Any] | None) -> Any:
        data = None if body is None else json.dumps(body).encode()
        request = urllib.request.Request(f"{self.url}/unit_api{path}", data, method=method)
        request.add_header("Content-Type", "application/json")
        try:
            with urllib.request.urlopen(request, timeout=self._timeout_s) as answer:
                return json.loads(answer.read() or b"null")
        except urllib.error.HTTPError as error:
            error.close()
            if 400 <= error.code < 500:
                raise NotHeard(f"{self.url}{path}: turned away with status {error.code}") from None
            raise ProtocolError(f"{self.url}{path}: status {error.code}") from None
        except urllib.error.URLError as error:
            kind = NotHeard if isinstance(error.reason, ConnectionRefusedError) else LinkError
            raise kind(f"{self.url}: {error.reason}; check power, network and backend.addresses") from None
        except (OSError, ValueError) as error:
            kind_of = ProtocolError if isinstance(error, ValueError) else LinkError
            raise kind_of(f"{self.url}{path}: {error or type(error).__name__}") from None
