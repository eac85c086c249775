"""MQTT of a cluster: the newest reports of each unit, stored by a listening thread, read by the driver's thread."""

import json
import math
import os
import socket
import threading
from collections import deque
from typing import Any, NamedTuple

from hardware.clock import Clock
from hardware.link.mqtt import MqttLink
from hardware.pioreactor.config import PioreactorConfig
from hardware.pioreactor.messages import MessageIgnored, OtherClient

KEPT, LONGEST = 2000, 100_000  # most readings and events; most bytes of a message
MOST_ML = 100.0  # an event reports less: half a second of a pump, or the volume of a job that stood still
LOCKS = "turbidostat/lock/"  # retained topics of the clients that control units; the last will clears them
PUMPS = MEDIA, ALT, WASTE = "add_media", "add_alt_media", "remove_waste"  # jobs, in the order of config.pump_pins
NAMES = {MEDIA: "media", ALT: "alt_media", WASTE: "waste"}  # as the vendor wires and calibrates them
SPARE = 3  # number of the alt-media pump
NUMBERS = {MEDIA: 0, ALT: SPARE, WASTE: 0}  # numbers of spare pumps in records
AUTOMATIONS = ("circulate_media", "circulate_alt_media", "pumps", "dosing_automation")  # drive several pumps
DOSING_JOBS = (*PUMPS, *AUTOMATIONS)
LIVE = ("init", "ready", "sleeping")
WORDS = (*LIVE, "disconnected", "lost")  # "lost" is sent by the broker: the job was killed, hangs, or lost the broker
ECHOES = ("stirring", "temperature_automation")  # jobs that repeatedly report all pins of the unit
CHANNELS = {"1": 17, "2": 13, "3": 16, "4": 12, "5": 18}  # GPIO pin of each PWM channel of the vendor's board
TWICE_S = 0.2  # least time between two separate messages


class Reading(NamedTuple):
    """One OD reading: time of arrival by this computer's clock, value, and whether it is calibrated (else volts)."""

    at: float
    value: float
    calibrated: bool = False


class Event(NamedTuple):
    """One dosing event: pump job, mL (reported before they are pumped), and id of the requester."""

    pump: str
    ml: float
    source: str


class State(NamedTuple):
    """Last state that a job reported, and the time of the report; -inf if the message was retained."""

    word: str = ""
    at: float = -math.inf


class Pin:
    """A pump's pin according to the messages about it.

    Attributes: on. on_s, off_s: times at which it last went on and off, -inf if unknown. ran_s: total time on up to
      off_s. inits: times at which processes of its job began. run_s, ended_s: times at which a process last reported
      that it runs, and that it ended. event_s: time of the first dosing event of this run of the pump, else inf.
      doubt_s: time of a report that the pin is on after its job had ended.
    """

    def __init__(self) -> None:
        self.on, self.ran_s = False, 0.0
        self.on_s = self.off_s = self.run_s = self.ended_s = self.doubt_s = -math.inf
        self.event_s = math.inf
        self.inits = deque[float](maxlen=8)

    def update(self, on: bool, at: float, word: str, echoes: bool) -> None:
        """Process a report of all pins of the unit. Args: at: its time, -inf if it was retained and the pin is on.

        word: state of the pump's job. echoes: other jobs report pins, too, but late: without a live job, on then counts
        only if it is reported twice.
        """
        if not on:
            self.ends(at)
        elif not self.on:
            if at > -math.inf and word == "lost":
                on_s = self.run_s
            elif word in LIVE or at == -math.inf or not echoes:
                on_s = at
            elif -math.inf < self.doubt_s < at - TWICE_S:
                on_s = self.doubt_s
            else:
                self.doubt_s = at if self.doubt_s == -math.inf else self.doubt_s
                return
            self.on, self.on_s = True, min(on_s, self.event_s)  # a job that hangs reports its pin late

    def ends(self, at: float) -> None:
        """End the pin's run; its time on counts only once."""
        began = self.on_s if self.on else self.event_s
        self.ran_s += at - began if math.isfinite(began) else 0.0
        if self.on or began < math.inf:
            self.off_s, self.on = at, False
        self.doubt_s, self.event_s = -math.inf, math.inf


class Mailbox:
    """Reports of one unit; filled by `take`, which another thread may call. Times are real seconds.

    A retained message of another experiment has no known time and is ignored.

    Attributes: readings, events, ignored: readings, dosing events and notes on invalid messages since the last `drain`.
      jobs: pin number of each pump's job. pins: state of each pin. states: state of each job, by experiment.
      temperature, target: of the thermostat, degC. stir_duty: %. heard_s: time of the unit's last message. dc_s: time
      of its last report of pins. complaint: why its OD reader took no reading, from its log.
    """

    def __init__(self, unit: str, config: PioreactorConfig, clock: Clock) -> None:
        self._root, self._channel, self._clock = f"pioreactor/{unit}/", config.of(unit).channel, clock
        self._experiment = config.experiment
        self.lock = threading.RLock()
        self.readings: deque[Reading] = deque(maxlen=KEPT)
        self.events: deque[Event] = deque(maxlen=KEPT)
        self.ignored: list[MessageIgnored] = []
        self._heard = deque[bytes](maxlen=100)
        self.jobs = dict(zip(PUMPS, config.pump_pins, strict=True))
        self.pins = {job: Pin() for job in PUMPS}
        self.states: dict[tuple[str, str], State] = {}
        self.temperature = self.target = self.stir_duty = math.nan
        self.heard_s = self.dc_s = -math.inf
        self.complaint, self._stamp, self._said = "", "", set[str]()

    def take(self, topic: str, payload: bytes, retained: bool) -> None:
        """Process a message; ignore an invalid message and note its kind once. Raises: nothing."""
        experiment, _, rest = topic.removeprefix(self._root).partition("/")
        try:
            with self.lock:
                if len(payload) > LONGEST:
                    raise ValueError(f"{len(payload)} bytes")
                if not (retained or rest.endswith("/set") or payload == b"lost"):  # not from others or the broker
                    self.heard_s = self._clock.now()
                self._enter(experiment, rest, payload, retained)
        except Exception as error:  # the calling thread must continue after any message
            kind = rest.rsplit("/", 1)[-1][:40]
            if kind not in self._said and len(self._said) < 100:
                self._said.add(kind)
                why = " ".join(str(error)[:80].split()) or type(error).__name__
                self.ignored.append(MessageIgnored(topic=rest[:60], why=why))

    def _enter(self, experiment: str, rest: str, payload: bytes, retained: bool) -> None:
        now, mine = self._clock.now(), experiment == self._experiment
        at = -math.inf if retained else now
        if rest.endswith("/$state") and payload:
            self._state(experiment, rest.removesuffix("/$state"), payload.decode(), at)
        elif rest in ("pwms/dc", "pwms/channel_dc") and (mine or not retained):
            said = json.loads(payload or b"{}")
            said = {CHANNELS.get(k, 0): dc for k, dc in said["channels"].items()} if "channels" in said else said
            duty = {int(pin): _number(dc) for pin, dc in said.items()}
            echoes = not mine or self.live(*ECHOES)
            for job, number in self.jobs.items():
                word = LIVE[0] if self.live(job, *AUTOMATIONS) else self.state(job).word
                on = duty.get(number, 0.0) > 0.0
                self.pins[job].update(on, at if on else now, word, echoes)  # off by now, even if retained
            self.dc_s = max(self.dc_s, at)
        elif rest == "dosing_events" and not retained and payload not in self._heard:  # a bridge may repeat one
            e = json.loads(payload)
            self._heard.append(payload)
            if not isinstance(e["event"], str):
                raise TypeError("an event without a name")
            event = Event(e["event"], _number(e["volume_change"]), str(e["source_of_event"]))
            if abs(event.ml) > MOST_ML:
                raise ValueError(f"{event.ml:g} mL")
            self.events.append(event)
            if event.pump in self.jobs and event.ml > 0.0 and self.live(event.pump):
                pin = self.pins[event.pump]
                pin.event_s = min(pin.event_s, now)
        elif rest == "od_reading/ods" and mine and payload:
            self._reading(json.loads(payload), now, retained)
        elif rest.startswith("logs/") and rest.endswith("/error") and mine and not retained:
            if (said := json.loads(payload)).get("task") == "od_reading":
                self.complaint = " ".join(str(said["message"]).split())[:200]
        elif rest == "temperature_automation/temperature" and mine and payload:
            self.temperature = _number(json.loads(payload)["temperature"])
        elif rest == "temperature_automation/target_temperature" and mine and payload:
            self.target = _number(payload)
        elif rest == "stirring/duty_cycle" and mine and payload:
            self.stir_duty = _number(payload)

    def _state(self, experiment: str, job: str, word: str, at: float) -> None:
        if word not in WORDS:
            raise ValueError(f"no state: {word[:40]!r}")
        known = self.states.get((experiment, job), State())
        self.states[experiment, job] = State(word, max(known.at, at) if word == known.word else at)
        if at == -math.inf or job not in self.jobs:
            return
        pin = self.pins[job]
        if word == "init":
            pin.inits.append(at)
        if word == "init" or (word in LIVE and known.word not in LIVE):
            pin.run_s = at
        elif word == "disconnected":
            pin.ended_s = at
            if pin.on_s >= pin.run_s or pin.run_s <= pin.event_s < math.inf:  # the pin's report may come later
                pin.ends(at)

    def _reading(self, said: dict[str, Any], now: float, retained: bool) -> None:
        """Store a reading, unless it was retained (an old reading) or has the timestamp of the last one (a copy)."""
        stamp = str(said["timestamp"])
        if retained or stamp == self._stamp:
            return
        mine = said["ods"][self._channel]
        value, self._stamp, self.complaint = _number(mine["od"]), stamp, ""
        self.readings.append(Reading(now, value, bool(mine.get("calibrated"))))

    def forget(self) -> None:
        """Forget the states of all jobs, which the jobs report again. A pump's job ends if it loses the broker."""
        with self.lock:
            self.states.clear()
            for pin in self.pins.values():
                pin.event_s = math.inf

    def drain(self) -> tuple[list[Reading], list[Event], list[MessageIgnored]]:
        """Return the readings, events and notes on ignored messages since the last call."""
        with self.lock:
            found = list(self.readings), list(self.events), list(self.ignored)
            for kind in (self.readings, self.events, self.ignored):
                kind.clear()
        return found

    def state(self, job: str) -> State:
        return self.states.get((self._experiment, job), State())

    def live(self, *jobs: str) -> bool:
        """Return whether one of these jobs runs, in this experiment or by a live report in another experiment."""
        with self.lock:
            known = [(s, e == self._experiment) for (e, name), s in self.states.items() if name in jobs]
        return any(s.word in LIVE and (mine or s.at > -math.inf) for s, mine in known)

    def on(self) -> list[str]:
        return [job for job, pin in self.pins.items() if pin.on]


def _number(said: Any) -> float:
    """Convert a number or text to a finite number. Raises: TypeError, ValueError, OverflowError."""
    value = float(said) if isinstance(said, int | float | str | bytes) and not isinstance(said, bool) else math.nan
    if not math.isfinite(value):
        raise ValueError(f"no number: {str(said)[:40]!r}")
    return value


class Cluster(MqttLink):
    """Connection to the broker of some units, and locks against other clients of these units. Raises: LinkError."""

    def __init__(self, config: PioreactorConfig, boxes: dict[str, Mailbox], name: str, clock: Clock) -> None:
        self._boxes, self._lock, self._others = boxes, LOCKS + name, dict[str, dict[str, Any]]()
        super().__init__(
            config.broker, config.broker_port, config.username, config.password(), name, clock, tls=config.tls,
            ca_file=config.ca_file, topics=[*(f"pioreactor/{unit}/#" for unit in boxes), f"{LOCKS}+"],
            take=self._message, again=self._forget, will=self._lock,
        )  # fmt: skip

    def _forget(self) -> None:
        """Forget all reports after a loss of the connection, because they may be outdated; retained ones come again."""
        self._others.clear()
        for box in self._boxes.values():
            box.forget()

    def _message(self, topic: str, payload: bytes, retained: bool) -> None:
        if topic.startswith(LOCKS):
            self._others.pop(topic, None)
            said = json.loads(payload[:LONGEST] or b"null")
            if isinstance(said, dict) and isinstance(said.get("units"), list) and topic != self._lock:
                self._others[topic] = said
        elif (unit := topic.split("/")[1]) in self._boxes:
            self._boxes[unit].take(topic, payload, retained)

    def hold(self) -> None:
        """Announce to the cluster's other clients that this program controls these units while it is connected."""
        self.keep(json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "units": list(self._boxes)}))

    def holder(self, unit: str) -> OtherClient | None:
        """Return the other client that controls a unit, or None; an earlier process of this run does not count."""
        for topic, said in list(self._others.items()):
            if unit in said["units"]:
                pid, host = str(said.get("pid"))[:20], str(said.get("host"))[:60]
                return OtherClient(pid=pid, host=host, unit=unit, topic=topic)
        return None
