"""Handle Ctrl-C and SIGTERM: stop the work, and return the exit code for the signal."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from bodycap_batch.core.errors import Cancelled

_received: list[int] = []


@contextmanager
def raise_on_signal() -> Iterator[None]:
    """Make SIGINT and SIGTERM raise `Cancelled` in the main thread."""

    def stop() -> None:
        raise Cancelled("stopped on request")

    with _handle_signals(stop):
        yield


@contextmanager
def event_on_signal() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set. The caller must check the event and stop its work."""
    event = threading.Event()
    with _handle_signals(event.set):
        yield event


def signal_exit_code() -> int:
    """Return the exit code after a signal: 128 plus the number of the last signal received."""
    return 128 + (_received[-1] if _received else signal.SIGINT)


@contextmanager
def _handle_signals(action: Callable[[], None]) -> Iterator[None]:
    """Call `action` when SIGINT or SIGTERM arrives; restore the earlier signal handlers at the end."""

    def handle(number: int, _: FrameType | None) -> None:
        _received.append(number)
        action()

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous_handlers = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)
