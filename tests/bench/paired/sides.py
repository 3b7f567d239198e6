"""The two sides of a comparison: a commit, or the working tree, with mechanisms switched off."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from tests.bench.rows import REPOSITORY

SWITCH = "BODYCAP_WITHOUT"
"""Environment variable with the mechanisms that a job leaves out."""
FROZEN = "d563f749"
"""Commit of version 0.2.0, against which the margins hold."""
_PACKAGE = "bodycap_batch"
_LONGEST = 60
"""Longest list of mechanisms, characters, in the name of a folder."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """One side of a comparison.

    Attributes:
        name: Name of the folder of its results: what it computes with, and what it leaves out.
        folder: Folder that contains the package.
        version: Commit, or digest of the package.
        without: Mechanisms that are switched off.
    """

    name: str
    folder: Path
    version: str
    without: tuple[str, ...] = ()

    def environment(self, threads: int) -> dict[str, str]:
        """Return the environment of a job's process."""
        own = {name: value for name, value in os.environ.items() if name != SWITCH}
        own |= {"PYTHONPATH": str(self.folder), "OMP_NUM_THREADS": str(threads)}
        return {**own, SWITCH: ",".join(self.without)} if self.without else own

    @property
    def is_frozen(self) -> bool:
        """True for version 0.2.0 as it is."""
        return self.version.startswith(FROZEN) and not self.without

    def code_lines(self) -> int:
        """Return the number of lines of the package that are neither empty nor comments."""
        return sum(
            bool(line.strip()) and not line.lstrip().startswith("#")
            for file in (self.folder / _PACKAGE).rglob("*.py")
            for line in file.read_text(encoding="utf-8").splitlines()
        )


def make_side(text: str, work: Path, repository: Path = REPOSITORY) -> Side:
    """Return a side, with its package in a folder of its own.

    Args:
        text: ``COMMIT`` or ``COMMIT-mechanism,mechanism``; ``.`` is the working tree as it is now.
        work: Folder of the comparison.
        repository: The repository.

    Raises:
        SystemExit: There is no such commit.
    """
    commit, without = _parts(text, repository)
    if commit == "." and not _git(repository, "status", "--porcelain", "--", _PACKAGE):
        commit = _git(repository, "log", "-1", "--format=%H", "--", _PACKAGE)
    if commit == ".":
        version = digest_of(repository / _PACKAGE)
        folder = _copy_of_package(repository, work / "sides" / f"tree-{version[:8]}")
    else:
        version = _git(repository, "rev-parse", "--verify", f"{commit}^{{commit}}")
        folder = _worktree(repository, version, work / "sides" / version[:8])
    left = "+".join(without)
    if len(left) > _LONGEST:
        left = f"{len(without)}_off_{hashlib.sha256(left.encode()).hexdigest()[:8]}"
    name = f"{folder.name}-{left}" if left else folder.name
    return Side(name=name, folder=folder, version=version, without=without)


def check_switches(side: Side) -> None:
    """Check that the version knows the mechanisms that are switched off.

    Raises:
        SystemExit: It does not. Without this check, a wrong name would look like a mechanism that never acts.
    """
    if not side.without:
        return
    done = subprocess.run(
        [sys.executable, "-c", "from bodycap_batch.core.mechanisms import switched_off; switched_off()"],
        cwd=side.folder,
        env=side.environment(1),
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        raise SystemExit(f"{side.name}: {' '.join(done.stderr.split()[-60:])}")


def left_out(a: Side, b: Side) -> tuple[Side, Side, tuple[str, ...]] | None:
    """Return the fuller side, the other one and what it leaves out, or None if they do not differ by that.

    The sides must be of one version, and one must leave out all that the other leaves out.
    """
    if a.version != b.version or a.without == b.without:
        return None
    for full, other in ((a, b), (b, a)):
        if set(full.without) < set(other.without):
            return full, other, tuple(sorted(set(other.without) - set(full.without)))
    return None


def simpler(a: Side, b: Side) -> Side:
    """Return the side that leaves out more mechanisms, or else the one with less code; B if equal."""
    if len(a.without) != len(b.without):
        return max(a, b, key=lambda side: len(side.without))
    return a if a.code_lines() < b.code_lines() else b


def digest_of(package: Path) -> str:
    """Return a digest of all files of a package."""
    digest = hashlib.sha256()
    for file in sorted(package.rglob("*")):
        if file.is_file() and "__pycache__" not in file.parts:
            content = file.read_bytes()
            digest.update(f"{file.relative_to(package)} {len(content)}\n".encode() + content)
    return digest.hexdigest()


def _parts(text: str, repository: Path) -> tuple[str, tuple[str, ...]]:
    """Return the commit and the mechanisms. A name of a branch may contain hyphens."""
    words = text.split("-")
    for count in range(len(words), 0, -1):
        commit = "-".join(words[:count])
        if commit == "." or _git(repository, "rev-parse", "-q", "--verify", f"{commit}^{{commit}}"):
            names = "-".join(words[count:]).split(",")
            return commit, tuple(sorted({name.strip() for name in names if name.strip()}))
    raise SystemExit(f"{text}: there is no such commit")


def _worktree(repository: Path, version: str, folder: Path) -> Path:
    if not (folder / _PACKAGE).is_dir():
        folder.parent.mkdir(parents=True, exist_ok=True)
        _git(repository, "worktree", "prune")
        _git(repository, "worktree", "add", "--force", "--detach", str(folder.resolve()), version)
    if not (folder / _PACKAGE).is_dir():
        raise SystemExit(f"{folder}: git could not make a worktree of {version}")
    return folder.resolve()


def _copy_of_package(repository: Path, folder: Path) -> Path:
    """Copy the package, so that later edits do not change a comparison that runs for hours."""
    if not folder.is_dir():
        part = folder.with_name(f".{os.getpid()}-{folder.name}")
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(repository / _PACKAGE, part / _PACKAGE, ignore=ignored)
        part.replace(folder)
    return folder.resolve()


def _git(repository: Path, *arguments: str) -> str:
    """Return what a git command prints; empty if it fails."""
    done = subprocess.run(
        ["git", "-C", str(repository), *arguments], capture_output=True, text=True, check=False
    )
    return done.stdout.strip() if done.returncode == 0 else ""
