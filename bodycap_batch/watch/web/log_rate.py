"""Limit the number of log messages, so that clients of the live page cannot fill the disk with messages."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_PERIOD_S = 60.0
"""Time (seconds) in which a limited number of messages is written. Evidence: none."""
_MAX_MESSAGES = 10
"""Maximum number of messages of one level and one logger in a period. Evidence: none."""


class MessageRateLimit(logging.Filter):
    """Pass a limited number of messages of each level in each period, and count the others.

    The first message of the next period states how many messages were left out.

    Args:
        clock: Function that returns the time (seconds) of this process's monotonic clock.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._lock = threading.Lock()
        self._periods: dict[int, tuple[float, int]] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        """Return True if the message may be written."""
        with self._lock:
            now = self._clock()
            started, number = self._periods.get(record.levelno, (now, 0))
            left_out = 0
            if now - started >= _PERIOD_S:
                left_out = max(0, number - _MAX_MESSAGES)
                started, number = now, 0
            self._periods[record.levelno] = started, number + 1
        if left_out:
            record.msg = f"{record.getMessage()} ({left_out} earlier messages were left out)"
            record.args = ()
        return number < _MAX_MESSAGES


@contextmanager
def limited_message_rate(*names: str) -> Iterator[None]:
    """Limit the messages of loggers while the body of the `with` statement runs.

    Args:
        names: Names of the loggers.
    """
    filters = [(logging.getLogger(name), MessageRateLimit()) for name in names]
    for logger, limit in filters:
        logger.addFilter(limit)
    try:
        yield
    finally:
        for logger, limit in filters:
            logger.removeFilter(limit)
