"""MQTT of a cluster: what each unit last said, kept by one listening thread and read by the driver's."""

import contextlib
import importlib
import json
import os
import socket
import threading
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

from hardware.clock import Clock
from hardware.errors import LinkError

__all__ = ["DOSING_JOBS", "Event", "Mailbox", "Mqtt", "Reading"]

KEPT = 2000
LOCKS = "turbidostat/lock/"  # who controls units of this cluster, retained, cleared by the last will
DOSING_JOBS = (
    "add_media", "remove_waste", "add_alt_media", "circulate_media", "circulate_alt_media", "pumps",
    "dosing_automation",
)  # fmt: skip
LIVE = ("init", "ready", "sleeping")  # states of a job that is there


class Reading(NamedTuple):
    """One OD reading: when it arrived by our clock, the unit's own timestamp, the value, whether it is calibrated."""

    at: float
    stamp: str
    value: float
    calibrated: bool


class Event(NamedTuple):
    """One dosing event: when it arrived, which pump job, mL (told before they are pumped), who asked for it."""

    at: float
    pump: str
    ml: float
    source: str


class Mailbox:
    """What one unit said; filled by `take`, which may be called from another thread.

    Attributes: readings and events, newest last, for the driver to take out; duty, of each pin that runs, by
      experiment; states, of each job; heard, when a job last told its state; temperature, and target of the
      thermostat, degC; refused, messages; ran_s, how long each pin has run by the clock, s.
    """

    def __init__(self, unit: str, experiment: str, channel: str, clock: Clock) -> None:
        self._root, self._channel, self._clock = f"pioreactor/{unit}/", channel, clock
        self.experiment = experiment
        self._lock = threading.Lock()
        self.readings: deque[Reading] = deque(maxlen=KEPT)
        self.events: deque[Event] = deque(maxlen=KEPT)
        self.duty: dict[str, dict[int, float]] = {}
        self.states: dict[tuple[str, str], str] = {}
        self.heard: dict[str, float] = {}
        self.ran_s: dict[int, float] = {}
        self._on: dict[int, float] = {}
        self.temperature = self.target = float("nan")
        self.refused = 0
        self._stamp = ""

    def take(self, topic: str, payload: bytes, retained: bool) -> None:
        """One message; what is not understood is left out."""
        if not topic.startswith(self._root):
            return
        experiment, _, rest = topic.removeprefix(self._root).partition("/")
        try:
            with self._lock:
                self._enter(experiment, rest, payload, retained)
        except (ValueError, KeyError, TypeError, AttributeError):
            self.refused += 1

    def _enter(self, experiment: str, rest: str, payload: bytes, retained: bool) -> None:
        now, mine = self._clock.now(), experiment == self.experiment
        if rest.endswith("/$state"):
            job = rest.removesuffix("/$state")
            self.states[experiment, job] = payload.decode()
            self.heard[job] = self.heard[job] if retained and job in self.heard else now
        elif rest == "pwms/dc":
            self._switched({int(k): float(v) for k, v in json.loads(payload or b"{}").items()}, experiment, now)
        elif rest == "dosing_events" and not retained:
            e = json.loads(payload)
            self.events.append(Event(now, e["event"], float(e["volume_change"]), str(e["source_of_event"])))
        elif rest == "od_reading/ods" and mine:
            self._reading(json.loads(payload), now, retained)
        elif rest == "temperature_automation/temperature" and mine:
            self.temperature = float(json.loads(payload)["temperature"])
        elif rest == "temperature_automation/target_temperature" and mine:
            self.target = float(payload or "nan")

    def _switched(self, duty: dict[int, float], experiment: str, now: float) -> None:
        """The pins that run now, and for how long those ran that do no more."""
        before, self.duty[experiment] = self.duty.get(experiment, {}), duty
        for pin in duty.keys() - before.keys():
            self._on[pin] = now
        for pin in before.keys() - duty.keys():
            self.ran_s[pin] = self.ran_s.get(pin, 0.0) + now - self._on.pop(pin, now)

    def _reading(self, said: dict[str, Any], now: float, retained: bool) -> None:
        """A retained reading is the last one of whatever was before; one with the stamp of another is the same."""
        stamp, one = str(said["timestamp"]), said["ods"][self._channel]
        if retained or stamp == self._stamp:
            self.refused += 1
            return
        self._stamp = stamp
        self.readings.append(Reading(now, stamp, float(one["od"]), bool(one.get("calibrated"))))

    def forget(self) -> None:
        """After a break: what was said before it may have changed since; what is retained is said again."""
        with self._lock:
            self.duty.clear()
            self.states.clear()

    def drain(self) -> tuple[list[Reading], list[Event]]:
        """Readings and events since the last call."""
        with self._lock:
            found = list(self.readings), list(self.events)
            self.readings.clear()
            self.events.clear()
        return found

    def running_pins(self, pins: Sequence[int]) -> list[int]:
        """Those of `pins` that run, by what the unit said last."""
        with self._lock:
            return [pin for pin in pins if any(of.get(pin, 0.0) > 0.0 for of in self.duty.values())]

    def live(self, job: str) -> bool:
        """Whether a job of this name is there, in whatever experiment."""
        with self._lock:
            return any(name == job and state in LIVE for (_, name), state in self.states.items())

    def been(self, job: str, since: float) -> bool:
        """Whether a job of this name came and went since that clock time."""
        return self.heard.get(job, float("-inf")) > since and not self.live(job)

    def lost(self, job: str) -> bool:
        """Whether a job of this name in our experiment ended without a word: its process was killed."""
        with self._lock:
            return self.states.get((self.experiment, job)) == "lost"


class Mqtt:
    """The connection to the broker, kept up by a thread of its own.

    Args: host, port, username, password: of the broker. boxes: of the units. name: of this client.
    Attributes: connected; since, clock time at which it last became so; breaks, how often it was lost.
    Raises: LinkError if the library is missing or the broker does not answer.
    """

    def __init__(
        self, host: str, port: int, login: tuple[str, str], boxes: dict[str, Mailbox], clock: Clock, name: str
    ) -> None:
        try:
            paho = importlib.import_module("paho.mqtt.client")
        except ImportError:
            raise LinkError("the Pioreactor needs the MQTT library: pip install 'paho-mqtt>=2'") from None
        self._boxes, self._clock = boxes, clock
        self.connected, self.since, self.breaks = False, float("-inf"), 0
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2, client_id=name)
        self._client.username_pw_set(*login)
        self._client.reconnect_delay_set(1, 5)
        self._lock, self._held, self._others = LOCKS + name, "", dict[str, dict[str, Any]]()
        self._client.will_set(self._lock, b"", qos=1, retain=True)
        self._client.on_connect, self._client.on_disconnect = self._up, self._down
        self._client.on_message = lambda _c, _u, m: self._message(m)
        try:
            self._client.connect(host, port, keepalive=10)
        except OSError as error:
            raise LinkError(
                f"MQTT broker {host}:{port}: {error}; check backend.broker and that the leader is on"
            ) from None
        self._client.loop_start()

    def _up(self, client: Any, _user: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if not reason.is_failure:
            for unit, box in self._boxes.items():
                box.forget()
                client.subscribe(f"pioreactor/{unit}/#", qos=1)
            self._others.clear()
            client.subscribe(f"{LOCKS}+", qos=1)
            if self._held:  # the last will of the connection before cleared it
                client.publish(self._lock, self._held, qos=1, retain=True)
            self.connected, self.since = True, self._clock.now()

    def _down(self, *_said: Any) -> None:
        self.connected, self.breaks = False, self.breaks + 1

    def hold(self) -> None:
        """Tell every other client of this cluster that these units are ours, as long as we are there."""
        self._held = json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "units": list(self._boxes)})
        self._client.publish(self._lock, self._held, qos=1, retain=True)

    def holder(self, unit: str) -> str:
        """Who else controls a unit, with the remedy, "" if nobody does; an earlier life of the same run is nobody."""
        for topic, said in list(self._others.items()):
            if unit in said.get("units", ()):
                who = f"process {said.get('pid')} on {said.get('host')} controls {unit}: one client per unit"
                return f"{who}; if it is not there any more: mosquitto_pub -r -n -t {topic}"
        return ""

    def _message(self, message: Any) -> None:
        if message.topic.startswith(LOCKS):
            self._others.pop(message.topic, None)
            with contextlib.suppress(ValueError):
                said = json.loads(message.payload or b"null")
                if isinstance(said, dict) and message.topic != self._lock:
                    self._others[message.topic] = said
            return
        unit = message.topic.split("/")[1]
        if unit in self._boxes:
            self._boxes[unit].take(message.topic, message.payload, bool(message.retain))

    def publish(self, topic: str, payload: str) -> bool:
        """Whether it was handed to the broker."""
        return self.connected and int(self._client.publish(topic, payload, qos=1).rc) == 0

    def close(self) -> None:
        """Idempotent."""
        if self._held and self.connected:
            self._held = ""
            with contextlib.suppress(RuntimeError, ValueError):
                self._client.publish(self._lock, b"", qos=1, retain=True).wait_for_publish(1.0)
        self._client.loop_stop()
        self._client.disconnect()
