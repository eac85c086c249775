"""Link to an emulated device in the same process: no socket, and on a virtual clock no waiting."""

from hardware.clock import Clock
from hardware.emulator.device import ChiBioDevice
from hardware.errors import LinkError
from hardware.link.transport import Reply, Transport

HEADERS = {"X-Requested-With": "XMLHttpRequest"}


class EmulatorTransport(Transport):
    """A link whose other end is `device`; time passes on the device's clock. Nothing to disarm, nothing to close.

    Like a client on a network it gives up after `timeout_s` while the server carries on with what it began, and every
    later request waits its turn behind that. Raises: ValueError for a time-out not positive.
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
