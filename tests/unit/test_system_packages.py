"""`.ci/system-packages` on machines that are pretended: a PATH with fake programs only."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / ".ci" / "system-packages"
TOOLS = ("bash", "env", "sh", "cat", "uname", "mkdir", "chmod", "cp")
OLD_PYTHON = "exit 1"
"""A Python of a version that is not supported refuses the script's question."""
GOOD_PYTHON = f'exec {sys.executable} "$@"'


def program(folder: Path, name: str, text: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """The programs of a machine without Python; its user is not root and has no sudo."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in TOOLS:
        found = shutil.which(tool)
        assert found
        (folder / tool).symlink_to(found)
    program(folder, "id", "echo 1000")
    program(folder, "sudo", "exit 1")
    return folder


def debian(machine: Path, python: str = GOOD_PYTHON) -> Path:
    """Add an apt-get that writes down what it is asked for, and that brings a Python."""
    asked = machine.parent / "asked"
    bring = f"#!/bin/sh\n{python}\n".replace("'", "'\\''")
    program(
        machine,
        "apt-get",
        f'echo "$*" >>{asked}\n'
        f"case \"$*\" in *' python3 '*) printf '%s' '{bring}' >{machine}/python3; "
        f"chmod +x {machine}/python3;; "
        "esac",
    )
    return asked


def ask(machine: Path, *arguments: str, **settings: str) -> subprocess.CompletedProcess[str]:
    settings = {"PATH": str(machine), "HOME": os.environ.get("HOME", "/"), **settings}
    command = [str(machine / "bash"), str(SCRIPT), *arguments]
    return subprocess.run(command, env=settings, capture_output=True, text=True, check=False)


def test_root_gets_a_python_where_there_is_none(machine: Path) -> None:
    program(machine, "id", "echo 0")
    asked = debian(machine)
    assert ask(machine).returncode == 0
    first, second = asked.read_text().splitlines()[:2]
    assert first == "update"
    assert second == "install --yes --no-install-recommends python3 python3-venv"
    assert ask(machine, "--python").stdout.strip() == str(machine / "python3")


def test_sudo_without_a_password_is_used(machine: Path) -> None:
    program(machine, "sudo", 'shift; exec "$@"')
    program(machine, "true", "exit 0")
    asked = debian(machine)
    assert ask(machine).returncode == 0
    assert "python3 python3-venv" in asked.read_text()


def test_a_user_without_rights_is_told_the_command(machine: Path) -> None:
    asked = debian(machine)
    done = ask(machine)
    assert done.returncode == 2
    assert (
        "sudo sh -c 'apt-get update && apt-get install --yes --no-install-recommends python3 python3-venv'"
        in done.stderr
    )
    assert not asked.exists()


@pytest.mark.parametrize("case", ["no packages", "a named Python", "a release with another Python"])
def test_what_cannot_be_installed_is_said(machine: Path, case: str) -> None:
    program(machine, "id", "echo 0")
    settings = {"PYTHON": "/nowhere/python3.12"} if case == "a named Python" else {}
    asked = None if case == "no packages" else debian(machine, OLD_PYTHON)
    done = ask(machine, **settings)
    assert done.returncode == 2
    assert "no Python 3.11, 3.12 or 3.13 found" in done.stderr
    assert (asked is not None and asked.exists()) == (case == "a release with another Python")


def test_asking_for_the_python_installs_nothing(machine: Path) -> None:
    program(machine, "id", "echo 0")
    asked = debian(machine)
    done = ask(machine, "--python")
    assert done.returncode == 2
    assert done.stdout == ""
    assert not asked.exists()
