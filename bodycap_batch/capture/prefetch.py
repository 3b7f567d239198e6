"""Run a generator ahead of its consumer, in one thread with a bounded queue."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")

_QUEUE_LENGTH = 4
"""Items made ahead. It bounds the memory."""


def prefetch(
    source: Generator[Item, None, None], threads: int = 0, ahead: int = _QUEUE_LENGTH
) -> Generator[Item, None, None]:
    """Yield the items of `source` while a thread makes the next `ahead` items.

    Decoding and resizing release the interpreter's lock, so they overlap with the consumer's work. The thread
    starts with the first requested item and ends with the generator, even with an abandoned one. An error of
    the source is raised in place of its item.

    Args:
        source: The generator.
        threads: Threads of the task. With one thread, each item is made when it is requested.
        ahead: Items made ahead.
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
