"""What keeps a watcher from its folders, while it does: a disk that is away, a permission that is gone."""

from __future__ import annotations

import time
from collections.abc import Callable

from bodycap_batch.core.errors import StoreError
from bodycap_batch.store.artefacts import store_error
from bodycap_batch.watch.spool import Spool

_FIRST_PAUSE_S = 1.0
_LONGEST_PAUSE_S = 60.0


class Trouble:
    """Is told each time the folders cannot be looked at; tells the operator once, and when it is over.

    Args:
        spool: The folders.
        tell: Called with a line for the operator.
        clock: This process's own clock, seconds.
    """

    def __init__(
        self, spool: Spool, tell: Callable[[str], None], clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._spool = spool
        self._tell = tell
        self._clock = clock
        self._since = 0.0
        self._pause_s = 0.0
        self.now: StoreError | None = None

    @property
    def text(self) -> str:
        """What is wrong at the moment; "" where nothing is."""
        now = self.now  # another thread asks, and it may be over at any moment
        return "" if now is None else f"{now.path}: {now.message}"

    @property
    def lasted_s(self) -> float:
        """For how long."""
        return 0.0 if self.now is None else self._clock() - self._since

    def met(self, error: OSError | StoreError) -> float:
        """Take a failure in; returns how long to wait before the next look, longer each time."""
        before, found = (
            self.text,
            store_error(error, self._spool.root) if isinstance(error, OSError) else error,
        )
        if self.now is None:
            self._since = self._clock()
        self.now = found
        if self.text != before:
            self._tell(f"{self.text}; the watcher tries again until that is over ({found.hint})")
        self._pause_s = min(_LONGEST_PAUSE_S, 2.0 * self._pause_s or _FIRST_PAUSE_S)
        return self._pause_s

    def over(self) -> None:
        """The folders can be looked at."""
        if self.now is not None:
            self._tell(f"{self._spool.root} answers again after {self.lasted_s:.0f} s; the watcher goes on")
        self.now, self._pause_s = None, 0.0
