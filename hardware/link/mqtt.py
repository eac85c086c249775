"""MQTT: a connection to a broker, which a thread keeps up."""

import contextlib
import importlib
import math
import ssl
from collections.abc import Callable, Sequence
from typing import Any

from hardware.clock import Clock
from hardware.link.messages import BrokerNotReached, NoMqtt


class MqttLink:
    """One client of a broker.

    Args: name: name of this client. ca_file: certificate authority of the broker, "": those of this computer. topics:
      filters to subscribe to. take: called with topic, payload and retained flag, on the connection's thread; its
      exceptions are lost. again: called on a new connection before any message. will: topic of this client, whose
      retained message the broker clears when the client is gone.
    Attributes: broke_s: time of the last loss of the connection, by `clock`. lost: reason of this loss. refusal: why
      the broker refused this client, "" if it did not, or was not reached.
    Raises: LinkError if the library or a certificate is missing, or the broker does not answer.
    """

    def __init__(
        self, host: str, port: int, username: str, password: str, name: str, clock: Clock, *, tls: bool, ca_file: str,
        topics: Sequence[str], take: Callable[[str, bytes, bool], None], again: Callable[[], None], will: str,
    ) -> None:  # fmt: skip
        try:
            paho = importlib.import_module("paho.mqtt.client")
        except ImportError:
            raise NoMqtt() from None
        self._clock, self._topics, self._again, self._will, self._kept = clock, tuple(topics), again, will, ""
        self.broke_s, self.lost, self.refusal, self._is_up = -math.inf, "", "", False
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2, client_id=name)
        self._client.username_pw_set(username, password)
        self._client.reconnect_delay_set(1, 5)
        self._client.will_set(will, b"", qos=1, retain=True)
        self._client.on_connect, self._client.on_disconnect = self._up, self._down

        def on_message(_client: Any, _user: Any, message: Any) -> None:
            with contextlib.suppress(Exception):  # an exception would end the thread unnoticed
                take(str(message.topic), bytes(message.payload), bool(message.retain))

        self._client.on_message = on_message
        try:
            if tls:
                self._client.tls_set_context(ssl.create_default_context(cafile=ca_file or None))
            self._client.connect(host, port, keepalive=10)
        except (OSError, ValueError) as error:  # also of TLS, and of a missing file
            raise BrokerNotReached(broker=f"{host}:{port}", error=error) from None
        self._client.loop_start()

    @property
    def connected(self) -> bool:
        """Whether the connection is up and its thread runs."""
        thread = getattr(self._client, "_thread", None)
        return self._is_up and thread is not None and thread.is_alive()

    def _up(self, client: Any, _user: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self.refusal = str(reason) if reason.is_failure else ""
        if not reason.is_failure:
            self._again()
            client.subscribe([(topic, 1) for topic in self._topics])
            if self._kept:  # the last will of the previous connection cleared it
                client.publish(self._will, self._kept, qos=1, retain=True)
            self._is_up = True

    def _down(self, _client: Any, _user: Any, _flags: Any, reason: Any, *_: Any) -> None:
        self.lost = "no more answers" if "alive" in str(reason) else "the broker closed the connection"
        self.broke_s = self._clock.now() if self._is_up else self.broke_s
        self._is_up = False

    def publish(self, topic: str, payload: str) -> None:
        """Publish; drop the message without a connection, because a late command may do harm."""
        if self.connected:
            self._client.publish(topic, payload, qos=1)

    def keep(self, payload: str) -> None:
        """Keep a retained message on `will` while this client is connected."""
        self._kept = payload
        self._client.publish(self._will, payload, qos=1, retain=True)

    def close(self) -> None:
        """Close the connection. Idempotent."""
        if self._kept and self.connected:
            self._kept = ""
            with contextlib.suppress(RuntimeError, ValueError):
                self._client.publish(self._will, b"", qos=1, retain=True).wait_for_publish(1.0)
        self._client.loop_stop()
        self._client.disconnect()
