"""Check whether this process may still write files of a job that several machines can see.

While a watcher is suspended, another watcher may take its job over. Therefore a watcher checks its ownership
of a job before each step that other processes can see: a commit to the store, a result, a move.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import Cancelled

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

    def require(self) -> None:
        """Raise `Cancelled` if another watcher has taken the job over."""
        if not self.is_held():
            raise Cancelled(
                "another watcher runs this job now",
                path=self.owner,
                hint="you need not do anything: the other watcher continues the job after its finished "
                "stages",
            )


def generation_marker(folder: Path, generation: int) -> Path:
    """Return the path of the file that reserves a claim number. Only one process can create this file."""
    return folder / f"{MARKER_PREFIX}{generation}"


def read_owner(path: Path) -> dict[str, Any]:
    """Return the content of `owner.json`; empty if the file is missing or cannot be read.

    Fields whose values have the wrong type are left out.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not isinstance(found, dict):
        return {}
    return {name: value for name, value in found.items() if isinstance(value, _FIELD_TYPES.get(name, object))}
