"""Claim a job, and show with a heartbeat that the watcher is alive.

The claims of a job are numbered. The file `owner.json` describes the current claim.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bodycap_batch.store.checked_json import checked_json
from bodycap_batch.store.digests import write_atomically
from bodycap_batch.watch.ownership import MARKER_PREFIX, Ownership, generation_marker, read_owner
from bodycap_batch.watch.process_identity import machine_id, process_start
from bodycap_batch.watch.spool import JobDir


class Claim:
    """A watcher's claim on a job. Its heartbeat shows other watchers that the job is being processed.

    Args:
        job: The job's folder.
        generation: Number of the claim; the first claim of a job has number 1.
        token: Unique name of the claim.

    Attributes:
        lost: Event that is set once another watcher has taken the job over.
    """

    def __init__(self, job: JobDir, generation: int, token: str) -> None:
        self.job = job
        self.generation = generation
        self.lost = threading.Event()
        self._token = token
        self._beat = 0
        self._lock = threading.Lock()
        self._ended = False

    @property
    def ownership(self) -> Ownership:
        """Object that checks whether this claim still holds.

        The check precedes each step that other processes can see.
        """
        return Ownership(owner=self.job.owner, token=self._token, generation=self.generation)

    def set_job_dir(self, job: JobDir) -> None:
        """Record that the job's folder has been renamed."""
        with self._lock:
            self.job = job

    def write_heartbeat(self) -> None:
        """Show that this watcher is alive. If another watcher has taken the job over, set `lost` instead."""
        with self._lock:
            if self._ended or self.lost.is_set():
                return
            with contextlib.suppress(OSError):  # the job's run reports a full or missing disk
                if self.ownership.is_held():
                    self._write()
                else:
                    self.lost.set()

    def release(self) -> None:
        """Allow other watchers to take the job over at once."""
        with self._lock:
            self._ended = True
            if self.ownership.is_held():
                self._write(released=True)

    def stop_heartbeat(self) -> None:
        """Stop the heartbeats of this claim, for example before the ended job moves to its final folder."""
        with self._lock:
            self._ended = True

    def _write(self, *, released: bool = False) -> None:
        self._beat += 1
        write_owner(self.job, self._token, self.generation, beat=self._beat, released=released)


def write_owner(job: JobDir, token: str, generation: int, *, beat: int = 0, released: bool = False) -> None:
    """Write `owner.json`.

    Args:
        job: The job's folder.
        token: Unique name of the claim.
        generation: Number of the claim.
        beat: Number of heartbeats so far. Each heartbeat changes the file, because the file holds this
            number.
        released: True if other watchers may take the job over at once.
    """
    document = {
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "generation": generation,
        "heartbeat": beat,
        "released": released,
        "token": token,
        "machine": machine_id(),
        "process": process_start(os.getpid()),
    }
    write_atomically(job.owner, checked_json(document).encode())


def create_claim(job: JobDir) -> Claim:
    """Make the first claim of a job whose folder no other process can see yet."""
    token = uuid.uuid4().hex
    generation_marker(job.path, 1).touch(exist_ok=False)
    write_owner(job, token, 1)
    return Claim(job, 1, token)


def take_over_job(job: JobDir) -> Claim | None:
    """Claim a job that its watcher abandoned.

    The new claim gets the next higher number (generation).

    Returns:
        The claim, or None if another watcher was faster or the job's folder is gone.
    """
    generation = 1 + max(_highest_generation(job), int(read_owner(job.owner).get("generation", 0)))
    token = uuid.uuid4().hex
    try:
        os.close(
            os.open(generation_marker(job.path, generation), os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        )
        write_owner(job, token, generation)
    except (FileExistsError, FileNotFoundError, NotADirectoryError):
        return None
    return Claim(job, generation, token)


def remove_claim_files(job: JobDir) -> None:
    """Remove the files of all claims from a job that has ended and is in its final folder."""
    for path in (*job.path.glob(f"{MARKER_PREFIX}*"), job.owner, job.cancel):
        path.unlink(missing_ok=True)


class HeartbeatMonitor:
    """Watch the heartbeats of other watchers.

    A job is treated as abandoned if its `owner.json` has not changed for `stale_s` seconds on this process's
    own clock. Clocks of different machines are never compared. A job is treated as abandoned at once in two
    cases: the owner released it, or the owner was a process of this machine that has ended.

    Args:
        stale_s: Minimum time (seconds) without a heartbeat before a job may be taken over.
        clock: Function that returns the time (seconds) of this process's monotonic clock.
    """

    def __init__(self, stale_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._stale_s = stale_s
        self._clock = clock
        self._machine = machine_id()
        self._seen: dict[Path, tuple[tuple[int, str], float]] = {}

    def find_abandoned(self, jobs: list[JobDir]) -> list[JobDir]:
        """Return the abandoned jobs in a list of jobs. These jobs may be taken over."""
        now = self._clock()
        before, self._seen = self._seen, {}
        abandoned = []
        for job in jobs:
            owner = read_owner(job.owner)
            state = (_highest_generation(job), json.dumps(owner, sort_keys=True))
            last_state, since = before.get(job.path, (state, now))
            since = since if last_state == state else now
            self._seen[job.path] = (state, since)
            if self._is_owner_gone(owner, state[0]) or now - since >= self._stale_s:
                abandoned.append(job)
        return abandoned

    def _is_owner_gone(self, owner: dict[str, Any], highest: int) -> bool:
        """Return True if the owner released the job, or was a process of this machine that has ended."""
        if not owner or owner.get("generation") != highest:
            return False
        if owner.get("released"):
            return True
        here = bool(self._machine) and owner.get("machine") == self._machine
        return here and process_start(int(owner.get("pid", 0))) != owner.get("process")


def _highest_generation(job: JobDir) -> int:
    numbers = (path.name.removeprefix(MARKER_PREFIX) for path in job.path.glob(f"{MARKER_PREFIX}*"))
    return max((int(number) for number in numbers if number.isdecimal()), default=0)
