"""The connection to one reactor: every request verified. No schedule, no policy, no safety rules."""

import math
from collections.abc import Mapping, Sequence

from hardware.chibio import messages
from hardware.chibio.protocol import PUMPS, WASTE, DeviceState, Permitted, check_command, parse_state
from hardware.clock import Clock
from hardware.errors import DeviceStateError, LinkError, ProtocolError, ReactorError
from hardware.link.transport import SharedLink, Transport
from hardware.logbook import Log, no_log

SEEN_S = 1.0
"""Time after an answer for which a reactor counts as present: a server that ended needs longer to listen again. After
this time the next command is preceded by a read, because a starting server carries out commands sent meanwhile, even
to a reactor that has become absent."""
SETTLE_S = 0.3
"""A pump command is answered before its thread has written to the bus (docs/device.md, Pumps)."""
DRAIN = 0.25
"""Duty of the waste pump while a feed pump may run; the device's software clears the waste tube with this duty."""


def identity(transport: Transport, clock: Clock, where: str) -> str:
    """Read the first present reactor's identity. Args: where: name of the link. Raises: as `Connection.read`."""
    reply = transport.get("/getSysdata/")
    if reply.status != 200:
        raise messages.WrongStatus(request=f"{where}: GET /getSysdata/", status=reply.status, expected=200)
    present = parse_state(reply.body).present
    if not present:
        raise messages.NoReactor()
    return Connection(present[0], Permitted(present[:1]), transport, clock, no_log).read().device_id


class Connection:
    """The verified conversation with one reactor.

    The device shows one selected reactor to all clients. A read is therefore changeDevice plus GET, valid only if the
    answer names this reactor and its pinned identity (docs/device.md, Selection). A command is sent only if the last
    verified read saw this reactor present, because a request to an absent one ends the whole server (docs/device.md,
    Failures). After a request without an answer, or `SEEN_S` without a request, a read precedes the next command.

    Args:
      name: position, M0 to M7. permitted: commands that this client may send.
      log: takes every command and its answer.
    """

    def __init__(self, name: str, permitted: Permitted, transport: Transport, clock: Clock, log: Log) -> None:
        self.name = name
        self.device_id = ""  # pinned at the first read
        self.state: DeviceState | None = None  # the last verified state
        self.took_s = 0.0  # how long the last verified read took
        self._unsure = False  # a request was not answered as expected since presence was last seen
        self._seen_s = -math.inf  # clock time at which this reactor was last known to be present
        self.clock, self._log = clock, log
        self._transport = transport if isinstance(transport, SharedLink) else SharedLink(transport, clock)
        self._permitted = permitted

    @property
    def heard_s(self) -> float:
        """Clock time of the newest answer over this link, to a request about any reactor."""
        return self._transport.heard_s

    def switched_off(self) -> Mapping[str, float]:
        """Return the pumps that a dead-man switch on the link switched off, and how many s ago. Raises: as `read`."""
        return self._transport.switched_off().get(self.name, {})

    def read(self, tries: int = 3) -> DeviceState:
        """Read the reactor's state; verify that it belongs to this reactor.

        Raises: LinkError, ProtocolError; DeviceStateError if it is absent or another client keeps selecting reactors;
          IdentityError if another unit answers at this position than before.
        """
        for _ in range(tries):
            start = self.clock.now()
            self._post(f"/changeDevice/{self.name}", quiet=True)
            state = self._look()
            ours = state.device_id != "" and self.device_id in ("", state.device_id)
            if state.selected == self.name and ours:
                break
        if state.selected != self.name:
            raise messages.CannotBeRead(reactor=self.name, shown=state.selected)
        if not ours:  # in no try, so this is not one garbled answer
            self.state = None
            found, pinned = state.device_id or "none", self.device_id or "none"
            raise messages.OtherIdentity(reactor=self.name, found=found, pinned=pinned)
        self.device_id = state.device_id
        self.state, self.took_s = state, self._since(start)
        return state

    def _look(self) -> DeviceState:
        """Read the state of the selected reactor; it also lists the reactors that are present. Raises: as `read`."""
        before, self._unsure = self._unsure, True
        reply = self._transport.get("/getSysdata/")
        if reply.status != 200:
            raise messages.WrongStatus(request="GET /getSysdata/", status=reply.status, expected=200)
        self._unsure = before  # only the server answers 200, even if the body is garbled
        state = parse_state(reply.body)
        self._unsure = False
        last = self.state
        if (
            last is not None
            and (last.selected, last.start_time) == (state.selected, state.start_time)
            and (state.cycles, state.sample_s) < (last.cycles, last.sample_s)  # else only the clock was set
        ):
            raise messages.OldAnswer()
        if self.name not in state.present:
            self.state = None  # nothing is sent to it from now on
            raise messages.Absent(reactor=self.name, present=", ".join(state.present) or "none")
        self._seen_s = self.clock.now()
        return state

    def post(self, path: str) -> None:
        """Send one command of `protocol.check_command`.

        Raises: LinkError (it may have been carried out), ProtocolError for a status other than 204, DeviceStateError
          if the command is not allowed or the reactor was absent at the last read.
        """
        if self.state is not None and (self._unsure or self.clock.now() - self._seen_s > SEEN_S):
            self._look()
        if self.state is None or self.name not in self.state.present:
            raise messages.NotSent(path=path, reactor=self.name)
        self._post(path)
        self._seen_s = self.clock.now()

    def toggle(self, path: str) -> DeviceState:
        """Send a toggle, which acts on the selected reactor, right after a read of this one; return the new state."""
        self.read()
        self._post(path)
        return self.read()

    def _post(self, path: str, quiet: bool = False) -> None:
        check_command(path, self._permitted)
        start = self.clock.now()
        answer: int | str = ""
        before, self._unsure = self._unsure, True
        try:
            reply = self._transport.post(path)
            answer = reply.status
        except ReactorError as error:
            answer = str(error)
            raise
        finally:
            if not quiet or answer != 204:
                self._log(
                    "command", {"reactor": self.name, "path": path, "answer": answer, "took_s": self._since(start)}
                )
        if reply.status != 204:
            raise messages.WrongStatus(request=f"POST {path}", status=reply.status, expected=204)
        self._unsure = before

    def _since(self, start: float) -> float:
        return round(self.clock.now() - start, 3)

    def target(self, item: str, value: float) -> None:
        """Set the target of `item`. Raises: as `post`."""
        self.post(f"/SetOutputTarget/{item}/{self.name}/{value:.6f}")

    def switch(self, item: str, on: bool) -> None:
        """Switch `item`; never a toggle. Raises: as `post`."""
        self.post(f"/SetOutputOn/{item}/{int(on)}/{self.name}")

    def set_blank(self, raw: float) -> None:
        """Make `raw` counts read as OD 0. Raises: as `post`, also for counts outside 3000 to 60000."""
        self.post(f"/CalibrateOD/OD0/{self.name}/{raw:.6f}/0")

    def pumps_off(self, tries: int = 3, pumps: Sequence[str] = PUMPS) -> None:
        """Switch these pumps off, verified; the waste pump last, and only if no feed pump may still run.

        Each pump is tried even if another pump fails, unless nothing answers. The flags show commands, not motors: with
        the bus hung they are off while the motor runs. A blocking call therefore touches the bus before the read. On a
        hung bus this call outlasts the server's worker, whose end switches everything off (docs/device.md, Failures).
        Raises: LinkError, ProtocolError, DeviceStateError if it could not be verified.
        """
        for attempt in range(tries):
            if attempt:
                self.clock.sleep(1.0)
            if self.state is None:
                self.read()  # presence first
            error: ReactorError | None = None
            refused: ProtocolError | None = None
            left = list(pumps)
            silent = 0  # time-outs are long: after two in a row, fail instead of trying the others
            for pump in sorted(pumps, key=WASTE.__eq__):
                if pump == WASTE and (error or refused):
                    break  # a feed pump may run
                try:
                    self.switch(pump, False)
                    left.remove(pump)
                    silent = 0
                except ProtocolError as failed:
                    refused = failed
                except LinkError as failed:
                    error, silent = failed, silent + 1
                    if silent == 2:
                        break
            if error is not None:
                continue
            self.clock.sleep(SETTLE_S)
            try:
                self.probe()
                state = self.read()
                on = [p for p in state.running_pumps if p in pumps]
                if not on:
                    return
                if set(on) - {WASTE} and WASTE not in state.running_pumps:
                    self.drain()
            except (LinkError, ProtocolError) as failed:
                error = failed
                continue
            named = ", ".join(pump for pump in on if pump != WASTE or on == [WASTE])
            why = f" ({refused})" if refused else ""
            error = messages.StillOn(reactor=self.name, pumps=named, refused=why)
        assert error is not None
        if isinstance(error, DeviceStateError):
            raise error
        raise error.about(f"{', '.join(left or pumps)} not verified off")

    def drain(self) -> None:
        """Switch the waste pump on, because a feed pump may run or has run without it. Raises: as `post`."""
        self.target(WASTE, DRAIN)
        self.switch(WASTE, True)

    def probe(self) -> None:
        """Touch the bus with a blocking call. Raises: LinkError if it hangs."""
        self.post(f"/MeasureTemp/IR/{self.name}")

    def escalate(self) -> None:
        """End the experiment of a pump that stays on, which switches everything off, then touch the bus."""
        for path in (f"/Experiment/0/{self.name}", f"/MeasureTemp/IR/{self.name}"):
            try:
                self.post(path)
            except ReactorError as error:
                self._log("escalation", {"reactor": self.name, "path": path, "error": str(error)})
