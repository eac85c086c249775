"""Errors of requests over a link: each one becomes a fault of kind link or prevents the start of a run."""

from hardware.errors import DeviceStateError, LinkError, ProtocolError

# fmt: off

class NotReached(LinkError, says="{request}: no answer from {host} ({why})", remedy="check cable and server"):
    """The cable or network is down, the board has no power, or the device's software does not run."""
class NotAnswered(LinkError, says="{request}: no answer from {host} ({why})",
    remedy="free space on the board's disk; close the device's web page"):
    """The device's software hangs or ended. A full disk stops it, and so does a measurement started in its web page."""
class NotComplete(LinkError, says="{request}: the answer was not complete after {seconds:.1f} s",
    remedy="look at the device; close web pages"): ...
class CutOff(LinkError, says="{request}: {url} closed the connection without a whole answer"):
    """The device's software ended."""
class NotHttp(ProtocolError, says="{request}: not an HTTP answer ({why})", remedy="check the address"): ...
class TooLong(ProtocolError, says="{request}: the answer is longer than {most} bytes", remedy="check the address"): ...
class NotYetSent(LinkError, says="{request}: not sent, because an earlier request failed: {error}"):
    """A recent request was not answered. The pause is 2 s, or 40 s if only this reactor does not answer."""
class AgentRefuses(LinkError, says="{request}: the board agent refuses it: {why}"):
    """401: no token. 403: the request comes from a browser. 409: another client is in charge."""
class AgentReachesNobody(LinkError, says="{request}: the board agent cannot reach the device ({why})",
    remedy="restart the device's software"): ...
class AgentReports(ProtocolError, says="{request}: the board agent reports status {status} ({why})"): ...
class AgentNotReadable(ProtocolError, says="the board agent's {what} is not readable: {said!r}",
    remedy="copy the agent to the board again"):
    """The board has another version of the agent, or another program. The run does not start."""
class AgentOutdated(ProtocolError, says="the board agent speaks protocol {protocol}, this driver protocol 2",
    remedy="copy this version's agent to the board"): ...
class PortNotOpened(LinkError, says="serial port {port}: {error}",
    remedy="check cable and port name, close other programs"):
    """Wrong name (ls -l /dev/serial/by-id), no rights (group dialout), or another program uses the port."""
class PortLost(LinkError, says="serial port {port} was lost ({error}); reopened at the next request",
    remedy="check the cable"): ...
class RequestTooLong(ProtocolError, says="{request}: {length} bytes, allowed {most}", remedy="report it"): ...
class DamagedFrames(ProtocolError, says="{request}: {count} damaged frames on {port}, none whole in {tries} tries",
    remedy="check that the agent runs and that no login prompt uses the line"): ...
class AgentSilent(LinkError, says="{request}: no reply on {port} in {tries} tries",
    remedy="check that the agent runs"): ...
class SecretUnusable(LinkError, says="{key} = {path}: {why}", remedy="{help}"):
    """The file of a token or password cannot be used, so the run does not start."""
class DeviceTaken(DeviceStateError, says="{device} is already controlled by process {holder}",
    remedy="one client per device: end the other one"): ...
class NoMqtt(LinkError, says="the MQTT library is missing", remedy="pip install 'paho-mqtt>=2'"): ...
class BrokerNotReached(LinkError, says="MQTT broker {broker}: {error}",
    remedy="check backend.broker, backend.tls and backend.ca_file, and that the broker runs"): ...
