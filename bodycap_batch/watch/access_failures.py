"""Report and wait while a watcher cannot access its folders.

Examples of causes are a missing disk and a missing permission.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from bodycap_batch.core.errors import StoreError
from bodycap_batch.store.artefacts import store_error
from bodycap_batch.watch.spool import Spool

_FIRST_PAUSE_S = 1.0
"""Time (seconds) between the first failure and the second attempt. Each further failure doubles this
time. Evidence: none."""
_MAX_PAUSE_S = 60.0
"""Maximum time (seconds) between two attempts. Evidence: none."""


class AccessFailures:
    """Track failures to access the folders of a spool.

    The operator gets one line when the failures start, one line for each different failure, and one line when
    the failures end.

    Args:
        spool: The spool that the watcher cannot access.
        write_line: Function that is called with each line for the operator.
        clock: Function that returns the time (seconds) of this process's monotonic clock.

    Attributes:
        current: The latest failure; None while the folders are accessible.
    """

    def __init__(
        self, spool: Spool, write_line: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._spool = spool
        self._write_line = write_line
        self._clock = clock
        self._since = 0.0
        self._pause_s = 0.0
        self.current: StoreError | None = None

    @property
    def text(self) -> str:
        """The current failure as text; "" if there is no failure."""
        failure = self.current  # read only once: the live page reads it in another thread
        return "" if failure is None else f"{failure.path}: {failure.message}"

    @property
    def duration_s(self) -> float:
        """Time (seconds) since the first of the current failures; 0 if there is no failure."""
        return 0.0 if self.current is None else self._clock() - self._since

    def record(self, error: OSError | StoreError) -> float:
        """Record a failure, and return the time (seconds) to wait before the next attempt."""
        previous_text = self.text
        failure = store_error(error, self._spool.root) if isinstance(error, OSError) else error
        if self.current is None:
            self._since = self._clock()
        self.current = failure
        if self.text != previous_text:
            self._write_line(
                f"{self.text}; the watcher tries again until the folder is accessible ({failure.hint})"
            )
        self._pause_s = min(_MAX_PAUSE_S, 2.0 * self._pause_s or _FIRST_PAUSE_S)
        return self._pause_s

    def clear(self) -> None:
        """Record that the folders are accessible again."""
        if self.current is not None:
            self._write_line(
                f"{self._spool.root} is accessible again after {self.duration_s:.0f} s; the watcher continues"
            )
        self.current, self._pause_s = None, 0.0
