"""Escape the characters of a text that could change what a terminal shows."""

from __future__ import annotations

import unicodedata

_ESCAPED_CATEGORIES = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
"""Unicode categories of the characters that are escaped: control characters (ESC, newline, BEL), invisible
format characters (changes of the text direction), unpaired surrogates, and separators of lines and
paragraphs."""
_JOINERS = "\u200c\u200d"
"""Format characters that are not escaped, because some scripts need them: ZERO WIDTH NON-JOINER and ZERO
WIDTH JOINER."""


def printable(text: str) -> str:
    r"""Return a text as one line that is safe to print: special characters are escaped, for example ``\x1b``.

    A terminal would execute control characters in the name of a file. Such a name could clear the screen, or
    imitate another line of a table.
    """
    if text.isascii() and text.isprintable():
        return text
    return "".join(_escaped(c) if _is_special(c) else c for c in text)


def _is_special(character: str) -> bool:
    return unicodedata.category(character) in _ESCAPED_CATEGORIES and character not in _JOINERS


def _escaped(character: str) -> str:
    return character.encode("unicode_escape", "backslashreplace").decode("ascii")
