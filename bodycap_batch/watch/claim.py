"""Who works on a job: `owner.json`, its generation number and its heartbeat."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import socket
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bodycap_batch.store.digests import write_atomically
from bodycap_batch.watch.guard import MARKER, Guard, marker, read_owner
from bodycap_batch.watch.spool import JobDir

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_PROCESS_NAMES = Path("/proc/self/ns/pid")


def host_key() -> str:
    """This machine since it was started, and where its process numbers hold (containers have their own)."""
    try:
        boot = _BOOT_ID.read_text(encoding="ascii").strip()
        names = os.readlink(_PROCESS_NAMES)
    except OSError:
        return ""
    return f"{socket.gethostname()}/{boot}/{names}"


def start_of(pid: int) -> str:
    """When a process of this machine was started, in the kernel's ticks; "" where there is none."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2]
    except OSError:
        return ""
    words = fields.split()
    return "" if words[0] in ("Z", "X") else words[19]


def process_mark() -> str:
    """This process, unlike any other of any machine, as part of a file's name."""
    return f"{_machine_mark()}-{os.getpid()}-{start_of(os.getpid())}"


def is_at_work(marked: str) -> bool:
    """Whether the process whose `process_mark` a name begins with is a running one of this machine."""
    machine, pid, start, *_ = [*marked.split("-"), "", ""]
    here = bool(host_key()) and machine == _machine_mark()
    return here and pid.isdecimal() and bool(start) and start_of(int(pid)) == start


def is_of_this_machine(marked: str) -> bool:
    """Whether a process of this machine, as long as it has been up, wrote that `process_mark`."""
    return bool(host_key()) and marked.split("-", maxsplit=1)[0] == _machine_mark()


def _machine_mark() -> str:
    return hashlib.sha256(host_key().encode()).hexdigest()[:12]


class Claim:
    """One watcher's hold on a job.

    Args:
        job: The job's folder.
        generation: Number of the claim.
        token: Names it.
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
    def guard(self) -> Guard:
        """What is asked before anything becomes visible."""
        return Guard(owner=self.job.owner, token=self._token, generation=self.generation)

    def moved_to(self, job: JobDir) -> None:
        """The job's folder has got another name."""
        with self._lock:
            self.job = job

    def beat(self) -> None:
        """Show that this watcher is alive; notice that the job belongs to somebody else."""
        with self._lock:
            if self._ended or self.lost.is_set():
                return
            with contextlib.suppress(OSError):  # a full or absent disk: the job itself will say so
                if self.guard.holds():
                    self._write()
                else:
                    self.lost.set()

    def release(self) -> None:
        """Let the job be taken over at once."""
        with self._lock:
            self._ended = True
            if self.guard.holds():
                self._write(released=True)

    def end(self) -> None:
        """Beat no more: the job is being filed away."""
        with self._lock:
            self._ended = True

    def _write(self, *, released: bool = False) -> None:
        self._beat += 1
        write_owner(self.job, self._token, self.generation, beat=self._beat, released=released)


def write_owner(job: JobDir, token: str, generation: int, *, beat: int = 0, released: bool = False) -> None:
    """Write `owner.json`."""
    document = {
        "host": socket.gethostname(),
        "pid": os.getpid(),
        "generation": generation,
        "heartbeat": beat,
        "released": released,
        "token": token,
        "machine": host_key(),
        "process": start_of(os.getpid()),
    }
    write_atomically(job.owner, (json.dumps(document, indent=1) + "\n").encode())


def first_claim(job: JobDir) -> Claim:
    """Claim a folder that nobody else can see yet."""
    token = uuid.uuid4().hex
    marker(job.path, 1).touch(exist_ok=False)
    write_owner(job, token, 1)
    return Claim(job, 1, token)


def take_over(job: JobDir) -> Claim | None:
    """Claim the next generation of a job whose owner is gone; None where somebody else was quicker."""
    generation = 1 + max(_highest_marker(job), int(read_owner(job.owner).get("generation", 0)))
    token = uuid.uuid4().hex
    try:
        os.close(os.open(marker(job.path, generation), os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644))
        write_owner(job, token, generation)
    except (FileExistsError, FileNotFoundError, NotADirectoryError):
        return None
    return Claim(job, generation, token)


def clear_claim(job: JobDir) -> None:
    """Remove the traces of ownership from a job that has been filed away."""
    for path in (*job.path.glob(f"{MARKER}*"), job.owner, job.cancel):
        path.unlink(missing_ok=True)


class Onlooker:
    """Watches other watchers' heartbeats.

    A heartbeat counts as stopped when this process's own clock has seen no change of `owner.json` for long
    enough: the clocks of hosts are never compared. Where the owner was a process of this machine that is
    gone, or let the job go, there is nothing to wait for.

    Args:
        stale_s: How long a heartbeat may stand still.
        clock: This process's own clock, seconds.
    """

    def __init__(self, stale_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._stale_s = stale_s
        self._clock = clock
        self._machine = host_key()
        self._seen: dict[Path, tuple[tuple[int, str], float]] = {}

    def abandoned(self, jobs: list[JobDir]) -> list[JobDir]:
        """Those of the jobs that may be taken over."""
        now = self._clock()
        before, self._seen = self._seen, {}
        found = []
        for job in jobs:
            owner = read_owner(job.owner)
            state = (_highest_marker(job), json.dumps(owner, sort_keys=True))
            known, since = before.get(job.path, (state, now))
            since = since if known == state else now
            self._seen[job.path] = (state, since)
            if self._is_gone(owner, state[0]) or now - since >= self._stale_s:
                found.append(job)
        return found

    def _is_gone(self, owner: dict[str, Any], highest: int) -> bool:
        """The owner said so, or was a process of this machine that has ended."""
        if not owner or owner.get("generation") != highest:
            return False
        if owner.get("released"):
            return True
        here = bool(self._machine) and owner.get("machine") == self._machine
        return here and start_of(int(owner.get("pid", 0))) != owner.get("process")


def _highest_marker(job: JobDir) -> int:
    numbers = (path.name.removeprefix(MARKER) for path in job.path.glob(f"{MARKER}*"))
    return max((int(number) for number in numbers if number.isdecimal()), default=0)
