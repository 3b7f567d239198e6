"""Produce the items of a generator in a thread, before the consumer requests them."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")

_QUEUE_LENGTH = 4
"""Number of items that are produced before they are requested. The limit bounds the memory."""


def prefetch(
    source: Generator[Item, None, None], threads: int = 0, ahead: int = _QUEUE_LENGTH
) -> Generator[Item, None, None]:
    """Yield the items of `source` while a thread produces the next items.

    Decoding and resizing release Python's interpreter lock, so they run in parallel with the consumer. The
    thread starts when the first item is requested. It ends when this generator ends or is closed. If the
    source raises an error, the error is raised in place of the item.

    Args:
        source: Generator of the items.
        threads: Number of threads that the task may use. With one thread, each item is produced only when it
            is requested.
        ahead: Number of items that are produced before they are requested.
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
