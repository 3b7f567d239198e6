"""Whether this process may still write for a job that several machines can see.

A watcher that was suspended wakes up not knowing that another one has taken its job over. So it looks again
before anything becomes visible: a commit to the store, a result, a move.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.core.errors import Cancelled

MARKER = ".generation-"
_EXPECTED: Mapping[str, type] = {"pid": int, "generation": int, "token": str, "machine": str, "process": str}
"""What somebody has put into the file by hand counts only where it is of the right kind."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Guard:
    """One claim on a job.

    Attributes:
        owner: The job's ``owner.json``.
        token: Names the claim, unlike any other.
        generation: How many claims there have been, this one included.
    """

    owner: Path
    token: str
    generation: int

    def holds(self) -> bool:
        """True while no later claim has been made."""
        folder = self.owner.parent
        if marker(folder, self.generation + 1).exists() or not marker(folder, self.generation).exists():
            return False
        found = read_owner(self.owner)
        # An owner that was taken over from may have woken up in the middle of its last heartbeat.
        outdated = int(found.get("generation", 0)) < self.generation
        return outdated or (found.get("token"), found.get("generation")) == (self.token, self.generation)

    def require(self) -> None:
        """Raise `Cancelled` where another watcher has taken the job over."""
        if not self.holds():
            raise Cancelled(
                "another watcher has taken this job over",
                path=self.owner,
                hint="nothing to do: it goes on there, from the finished stages",
            )


def marker(folder: Path, generation: int) -> Path:
    """File whose making is the claim of a generation: only one process can be first."""
    return folder / f"{MARKER}{generation}"


def read_owner(path: Path) -> dict[str, Any]:
    """What ``owner.json`` says; empty where there is none or it cannot be read."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not isinstance(found, dict):
        return {}
    return {name: value for name, value in found.items() if isinstance(value, _EXPECTED.get(name, object))}
