"""How signals end a run: they stop the loop like Ctrl-C, and they do not cut short the switching off of the pumps."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from types import FrameType

__all__ = ["held_back", "like_ctrl_c"]

log = logging.getLogger(__name__)


def like_ctrl_c() -> AbstractContextManager[None]:
    """SIGTERM (a service manager, a shutting-down PC) and SIGHUP (a closed terminal) raise KeyboardInterrupt."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    return _handled(interrupt, signal.SIGTERM, signal.SIGHUP)


def held_back() -> AbstractContextManager[None]:
    """A second Ctrl-C, SIGTERM or SIGHUP does not end the program before the pumps are verified off."""

    def answer(number: int, frame: FrameType | None) -> None:
        log.warning("the pumps are being switched off and verified; this takes up to a minute")

    return _handled(answer, signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], None], *numbers: int) -> Iterator[None]:
    """These signals call `handler` for a while, except those that are ignored on purpose (nohup)."""
    before = {n: old for n in numbers if (old := signal.getsignal(n)) is not signal.SIG_IGN}
    for number in before:
        signal.signal(number, handler)
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
