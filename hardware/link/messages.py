"""Errors of requests over a link; each is part of a fault of kind link, or ends a start."""

from hardware.errors import DeviceStateError, LinkError, ProtocolError

# fmt: off

class NotReached(LinkError, says="{request}: no answer from {host} ({why})", remedy="check cable and server"):
    """Cable, network, power of the board, or the device's software is off."""
class NotAnswered(LinkError, says="{request}: no answer from {host} ({why})",
    remedy="its software hangs or ended: look at the board's disk, close its web page"):
    """Reached, and no answer in time, or cut off: a full disk stops it, and so does a measurement from its web page."""
class NotComplete(LinkError, says="{request}: the answer was not complete after {seconds:.1f} s",
    remedy="look at the device; close web pages"): ...
class CutOff(LinkError, says="{request}: {url} closed the connection without a whole answer"):
    """The device's software ended."""
class NotHttp(ProtocolError, says="{request}: not an HTTP answer ({why})", remedy="check the address"): ...
class TooLong(ProtocolError, says="{request}: the answer is longer than {most} bytes", remedy="check the address"): ...
class NotYetSent(LinkError, says="{request}: not sent, a moment ago: {error}"):
    """The device has just not answered another reactor; asked again in two seconds."""
class AgentRefuses(LinkError, says="{request}: the board agent refuses it: {why}"):
    """401 no token, 403 a browser asks, 409 another client is in charge."""
class AgentReachesNobody(LinkError, says="{request}: the board agent cannot reach the device ({why})",
    remedy="restart the device's software"): ...
class AgentReports(ProtocolError, says="{request}: the board agent reports status {status} ({why})"): ...
class AgentNotReadable(ProtocolError, says="the board agent's {what} is not readable: {said!r}",
    remedy="copy the agent anew"):
    """Another version of the agent, or another program; the run does not start."""
class AgentOutdated(ProtocolError, says="the board agent speaks protocol {protocol}, this driver 2",
    remedy="install the same version"): ...
class PortNotOpened(LinkError, says="serial port {port}: {error}",
    remedy="check cable and port name, close other programs"):
    """Wrong name (ls -l /dev/serial/by-id), no rights (group dialout), or another program has it."""
class PortLost(LinkError, says="serial port {port} was lost ({error}); reopened at the next request",
    remedy="look at the cable"): ...
class RequestTooLong(ProtocolError, says="{request}: {length} bytes, allowed {most}", remedy="report it"): ...
class DamagedFrames(ProtocolError, says="{request}: {count} damaged frames on {port}, none whole in {tries} tries",
    remedy="is the agent running? A login prompt may have the line"): ...
class AgentSilent(LinkError, says="{request}: no reply on {port} in {tries} tries", remedy="is the agent running?"): ...
class SecretUnusable(LinkError, says="{key} = {path}: {why}", remedy="{help}"):
    """A file of a token or password; the run does not start."""
class DeviceTaken(DeviceStateError, says="{device} is already controlled by process {holder}",
    remedy="one client per device: end the other one"): ...
class NoMqtt(LinkError, says="MQTT needs its library", remedy="pip install 'paho-mqtt>=2'"): ...
class BrokerNotReached(LinkError, says="MQTT broker {broker}: {error}",
    remedy="check backend.broker, backend.tls and backend.ca_file, and that the broker runs"): ...
