"""Find names that are not taken."""

from __future__ import annotations

from collections.abc import Container


def unique_name(name: str, taken: Container[str], separator: str = "_") -> str:
    """Return a name, with the first free number from 2 on appended if it is taken."""
    free, number = name, 2
    while free in taken:
        free, number = f"{name}{separator}{number}", number + 1
    return free
