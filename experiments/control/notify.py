"""Notification: a line of JSON to a command or an HTTP address at start, alarm, hand-over and end of a run.

Notification never delays a dose: a separate thread sends the messages from a short queue, each try has a time limit,
and messages that do not fit into the queue are dropped and counted. An address is a secret, because many services
identify their user by it: it is kept only in the environment, and the log shows only its scheme and host.
"""

import json
import logging
import os
import shlex
import shutil
import signal
import subprocess
from collections.abc import MutableMapping, Sequence
from contextlib import suppress
from datetime import datetime
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

from experiments.cli import frame
from experiments.cli.outlet import Outlet
from experiments.control import messages

log = logging.getLogger(__name__)

HOOK = "DEPLOY_HOOK"  # environment variable that receives an address from the command line
LIMIT_S, LAST_S, WAITING = 10.0, 3.0, 32  # time limit of a try; time to send the rest at the end; length of the queue
ADDRESS = ("http://", "https://")


def hidden(arguments: Sequence[str], environment: MutableMapping[str, str]) -> list[str]:
    """Move the address of `notify=https://...` into the environment; return arguments with notify=env:DEPLOY_HOOK."""
    out = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        value = value.strip(" \t'\"")
        if key.lstrip("+") == "notify" and value.lower().startswith(ADDRESS):
            environment[HOOK] = value
            argument = f"notify=env:{HOOK}"
        out.append(argument)
    return out


class Hook:
    """Receiver of messages: a command, started for each message with it on standard input, or an address (HTTP POST).

    Args: target: command line or address. limit_s: time limit of one try.
    Attributes: name: the receiver in the log, without secrets.
    Raises: UserError for an invalid command line, an unknown command, or an address without a host.
    """

    def __init__(self, target: str, limit_s: float = LIMIT_S) -> None:
        self._limit_s, self._target = limit_s, target
        self._child: subprocess.Popen[bytes] | None = None
        self._by_http = target.lower().startswith(ADDRESS)
        if self._by_http:
            with suppress(ValueError):
                parts = urlsplit(target)
                if parts.hostname:
                    self.name = f"{parts.scheme}://{parts.hostname}/…"
                    return
            raise messages.NoHost()
        try:
            self._command = shlex.split(target)
        except ValueError as error:
            raise messages.NoCommand(why=f"the command cannot be read ({error})") from None
        if not self._command or shutil.which(self._command[0]) is None:
            raise messages.NoCommand(why="there is no such command")
        self.name = Path(self._command[0]).name

    def send(self, line: bytes) -> str:
        """Send one line; return the reason of a failure, without secrets, or ""."""
        try:
            return self._post(line) if self._by_http else self._run(line)
        except Exception as error:  # no error of the receiver may end the run
            return type(error).__name__

    def _post(self, line: bytes) -> str:
        import httpx

        headers = {"Content-Type": "application/json"}
        status = httpx.post(self._target, content=line, headers=headers, timeout=self._limit_s).status_code
        return "" if status < 300 else f"status {status}"

    def _run(self, line: bytes) -> str:
        self._child = subprocess.Popen(self._command, stdin=subprocess.PIPE, start_new_session=True)
        try:
            self._child.communicate(line, timeout=self._limit_s)
        finally:
            self.give_up()
        return f"exit status {self._child.returncode}" if self._child.returncode else ""

    def give_up(self) -> None:
        """Kill a command that is still running, and all its child processes."""
        if self._child is not None and self._child.poll() is None:
            with suppress(ProcessLookupError):
                os.killpg(self._child.pid, signal.SIGKILL)
            with suppress(subprocess.TimeoutExpired):
                self._child.wait(1.0)


class Notifier:
    """Sender of a run's messages. Call it to queue a message; a call never waits and never raises.

    Args: hook: receiver; None: no message is sent. run: run folder.
    Attributes: sent, failed, dropped: numbers of messages.
    """

    def __init__(self, hook: Hook | None, run: Path) -> None:
        self._hook, self._run = hook, str(run)
        self.sent = self.failed = 0
        self._outlet = None if hook is None else Outlet(partial(self._send, hook), WAITING)

    @property
    def dropped(self) -> int:
        """Number of messages that did not fit into the queue."""
        return 0 if self._outlet is None else self._outlet.dropped

    def __call__(self, event: str, text: str, reactor: str = "") -> None:
        """Queue a message. Args: event: start, alarm, hand_over, policy or end. reactor: its name, "" for all."""
        if self._outlet is None:
            return
        at = datetime.now().astimezone().isoformat(timespec="seconds")
        message = {"event": event, "time": at, "run": self._run, "reactor": reactor, "text": text}
        line = json.dumps({k: v for k, v in message.items() if v}).encode() + b"\n"
        if not self._outlet.put(line) and self.dropped == 1:
            log.warning(messages.HookDropping())

    def _send(self, hook: Hook, line: bytes) -> None:
        problem = hook.send(line)
        self.sent, self.failed = self.sent + (not problem), self.failed + bool(problem)
        if problem and self.failed == 1:
            log.warning(messages.HookFailed(hook=hook.name, why=problem))

    def close(self) -> None:
        """Wait a few seconds for queued messages, discard the rest, and log the counts. Idempotent."""
        if self._outlet is None or self._hook is None:
            return
        left, dropped = self._outlet.close(LAST_S), self.dropped
        self._hook.give_up()
        self._outlet = None
        counts = {"sent": self.sent, "failed": self.failed, "dropped": dropped, "left": left}
        log.info(messages.HookTally(hook=self._hook.name, **counts))


def opened(target: str, run: Path, resumed: bool) -> Notifier:
    """Open the notifier that a config's `notify` names. Raises: UserError for an unusable receiver.

    A resumed run only logs this error and continues without messages, because a culture waits for it.
    """
    try:
        if target.startswith("env:"):
            name = target.removeprefix("env:")
            target = os.environ.get(name, "").strip()
            if not target:
                raise messages.NotSet(name=name)
        hook = Hook(target) if target else None
    except frame.UserError as error:
        if not resumed:
            raise
        log.warning(messages.HookUnusable(why=error))
        hook = None
    return Notifier(hook, run)
