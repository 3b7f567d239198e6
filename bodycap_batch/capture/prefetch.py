"""Run a generator ahead of its consumer, in one thread with a bounded queue, where there is a core for it."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")

_QUEUE_LENGTH = 4


def prefetch(
    source: Generator[Item, None, None], threads: int = 0, ahead: int = _QUEUE_LENGTH
) -> Generator[Item, None, None]:
    """Yield what `source` yields while the next `ahead` items are made in a thread.

    Decoding and resizing release the interpreter's lock, so they overlap with the consumer's work.
    The thread starts with the first item asked for and ends with the generator, also an abandoned
    one. An error of the source is raised where its item would have come. A task that was given one
    thread makes each item when it is asked for: its neighbours have the other cores.
    """
    if threads == 1:
        yield from source
        return
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="decode") as pool:
        pending = deque(pool.submit(next, source, None) for _ in range(ahead))
        try:
            while (item := pending.popleft().result()) is not None:
                pending.append(pool.submit(next, source, None))
                yield item
        finally:
            for future in pending:
                future.cancel()
            pool.submit(source.close).result()
