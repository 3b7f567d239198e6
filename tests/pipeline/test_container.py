"""The recipe of the container: its base is fixed, and it is built where an image builder works."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

import bodycap_batch

ROOT = Path(__file__).parents[2]
RECIPE = ROOT / "examples" / "Containerfile"
IMAGE = "localhost/bodycap-test"


def instructions() -> list[str]:
    text = "\n".join(line for line in RECIPE.read_text().splitlines() if not line.startswith("#"))
    return [line.split(maxsplit=1)[0] for line in text.replace("\\\n", "").splitlines() if line.strip()]


def working_builder() -> str | None:
    """Return the image builder of this machine that can build. A client without its service cannot."""
    for name in ("podman", "buildah", "docker"):
        if (
            shutil.which(name)
            and subprocess.run([name, "info"], capture_output=True, check=False).returncode == 0
        ):
            return name
    return None


def test_the_base_of_the_container_is_one_image_for_ever() -> None:
    (base,) = re.findall(r"^FROM (\S+)$", RECIPE.read_text(), re.MULTILINE)
    assert re.fullmatch(r"docker\.io/library/debian:bookworm-slim@sha256:[0-9a-f]{64}", base)


def test_the_steps_that_are_tried_in_a_bare_debian_are_those_of_the_recipe() -> None:
    """`make test-fresh ARGS=--container` carries out the recipe without an image builder."""
    script = (ROOT / ".ci" / "test-fresh").read_text()
    known = set(
        re.findall(r"\b[A-Z]{3,}\b", script[script.index("case $instruction in") : script.index("esac")])
    )
    assert set(instructions()) <= known
    assert {"FROM", "RUN", "COPY", "USER"} <= set(instructions())


@pytest.mark.slow
def test_the_container_is_built_and_watches_its_folder(tmp_path: Path) -> None:
    builder = working_builder()
    if builder is None:
        pytest.skip(
            "no image builder works here (podman, buildah, docker): make test-fresh ARGS=--container instead"
        )
    clone = tmp_path / "clone"
    subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", str(ROOT), str(clone)], check=True)
    build = [builder, "build", "--tag", IMAGE, "--file", "examples/Containerfile", "."]
    subprocess.run(build, cwd=clone, check=True)
    run = [builder, "run", "--rm", IMAGE]
    if builder == "buildah":  # it runs a command in a container, without the entry point of the image
        made = subprocess.run([builder, "from", IMAGE], capture_output=True, text=True, check=True).stdout
        run = [builder, "run", made.strip(), "--", "/opt/bodycap_batch/.venv/bin/bodycap"]
    try:
        version = subprocess.run([*run, "--version"], capture_output=True, text=True, check=True).stdout
        assert version.strip() == f"bodycap {bodycap_batch.__version__}"
        subprocess.run([*run, "watch", "/jobs/inbox", "--once"], check=True)
    finally:
        subprocess.run([builder, "rmi", "--force", IMAGE], check=False)
