"""Link to an emulated device in the same process: without a socket and, on a virtual clock, without waiting."""

from hardware.clock import Clock
from hardware.emulator.device import ChiBioDevice
from hardware.errors import LinkError
from hardware.link.transport import Reply, Transport

HEADERS = {"X-Requested-With": "XMLHttpRequest"}


class EmulatorTransport(Transport):
    """A link to `device`; time passes on the device's clock. There is nothing to disarm or close.

    As over a network, the client gives up after `timeout_s`, while the server continues the request and every later
    request waits for it. Raises: ValueError if the time-out is not positive.
    """

    def __init__(self, device: ChiBioDevice, timeout_s: float = 20.0) -> None:
        if not timeout_s > 0.0:
            raise ValueError(f"timeout_s = {timeout_s} s: allowed > 0; the device's worker limit is 30 s, use 20")
        self._device, self._timeout_s = device, timeout_s
        self._clock: Clock = device.clock

    def _request(self, method: str, path: str) -> Reply:
        device, clock = self._device, self._clock
        device.run_until(clock.now())
        deadline = clock.now() + self._timeout_s
        exchange = device.submit(method, path, HEADERS)
        while not exchange.done or exchange.fate == "lost":
            if clock.now() >= deadline:
                raise LinkError(f"{method} {path}: no answer within {self._timeout_s:g} s; the device may have acted")
            clock.sleep(min(device.next_time(), deadline) - clock.now())
            device.run_until(clock.now())
        if exchange.answer is None:
            raise LinkError(f"{method} {path}: connection {exchange.fate}")
        if exchange.cut:
            raise LinkError(f"{method} {path}: connection closed {exchange.cut} bytes before the end of the answer")
        return Reply(*exchange.answer[:2])
