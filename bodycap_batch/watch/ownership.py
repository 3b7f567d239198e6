"""Check whether this process may still write files of a job that several machines can see.

While a watcher is suspended, another watcher may take its job over. Therefore a watcher checks its ownership
of a job before each step that other processes can see: a commit to the store, a result, a move.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.store.checked_json import parse_checked_json

MARKER_PREFIX = ".generation-"
_FIELD_TYPES: Mapping[str, type] = {
    "pid": int,
    "generation": int,
    "token": str,
    "machine": str,
    "process": str,
}
"""Types of the fields of `owner.json`. A value of another type is ignored: a user may have edited the file.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ownership:
    """Check whether one claim still owns its job.

    The claims of a job are numbered. A claim loses the job when a watcher makes a claim with a higher number.

    Attributes:
        owner: Path of the job's `owner.json`.
        token: Unique name of the claim.
        generation: Number of the claim; the first claim of a job has number 1.
    """

    owner: Path
    token: str
    generation: int

    def is_held(self) -> bool:
        """Return True if this claim exists and no later claim has been made."""
        folder = self.owner.parent
        if (
            generation_marker(folder, self.generation + 1).exists()
            or not generation_marker(folder, self.generation).exists()
        ):
            return False
        found = read_owner(self.owner)
        # A suspended earlier owner may write `owner.json` once more after it has lost the job. Such a file
        # has a lower claim number and is ignored.
        outdated = int(found.get("generation", 0)) < self.generation
        return outdated or (found.get("token"), found.get("generation")) == (self.token, self.generation)

    def has_claim(self) -> bool:
        """Return True if the job's folder holds a file of this claim or of the next claim."""
        folder = self.owner.parent
        numbers = (self.generation, self.generation + 1)
        return any(generation_marker(folder, number).exists() for number in numbers)


def generation_marker(folder: Path, generation: int) -> Path:
    """Return the path of the file that reserves a claim number. Only one process can create this file."""
    return folder / f"{MARKER_PREFIX}{generation}"


def read_owner(path: Path) -> dict[str, Any]:
    """Return the content of `owner.json`; empty if the file is missing, damaged or cannot be read."""
    try:
        found = parse_checked_json(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return {name: value for name, value in found.items() if isinstance(value, _FIELD_TYPES.get(name, object))}
