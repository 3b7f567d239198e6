"""Write the script that builds a Blender scene, its data, and the same script as a Blender extension."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bodycap_batch
from bodycap_batch.formats.atomic_files import atomic_replacement, write_text
from bodycap_batch.formats.blender.scene_script import SCENE_FILE, SCRIPT_FILE
from bodycap_batch.formats.fbx.blender_process import run_script

EXTENSION_FILE = "bodycap_blender.zip"
_SCRIPT = Path(__file__).with_name("scene_script.py")

_MANIFEST = """\
schema_version = "1.0.0"
id = "bodycap_results"
version = "{version}"
name = "bodycap results"
tagline = "Import body, room and body cameras from a results folder"
maintainer = "bodycap_batch contributors"
type = "add-on"
blender_version_min = "4.2.0"
license = ["SPDX:MIT"]
tags = ["Import-Export", "Animation"]

[permissions]
files = "Read the results folder and the videos"
"""


def write_blender_files(folder: Path, scene: Mapping[str, Any]) -> list[Path]:
    """Write the script, its data and the extension into a folder, and return their paths.

    Args:
        folder: The folder of results.
        scene: The content of the data file, as plain JSON values.

    Raises:
        StoreError: A file cannot be written.
    """
    script = _SCRIPT.read_text(encoding="utf-8")
    write_text(folder / SCENE_FILE, json.dumps(scene, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
    write_text(folder / SCRIPT_FILE, script)
    with atomic_replacement(folder / EXTENSION_FILE) as temporary:
        temporary.write_bytes(_extension(script))
    return [folder / name for name in (SCENE_FILE, SCRIPT_FILE, EXTENSION_FILE)]


def _extension(script: str) -> bytes:
    """Return the content of the extension's ZIP file."""
    stream = io.BytesIO()
    manifest = _MANIFEST.format(version=bodycap_batch.__version__)
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in (("blender_manifest.toml", manifest), ("__init__.py", script)):
            # The time of a ZipInfo is a constant, so that equal runs give equal files.
            archive.writestr(zipfile.ZipInfo(name), text, zipfile.ZIP_DEFLATED)
    return stream.getvalue()


def write_blend(path: Path) -> Path:
    """Write the scene as a .blend file. Blender runs the script in the folder of the file.

    Args:
        path: Path of the file. Its folder holds the files of `write_blender_files`, the motion and the map.

    Returns:
        The path of the file.

    Raises:
        JobError: Blender was not found.
        StoreError: Blender failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        temporary = Path(folder) / path.name
        run_script(path.parent / SCRIPT_FILE, ["--save", str(temporary)], made=temporary, path=path)
        with atomic_replacement(path) as target:
            target.write_bytes(temporary.read_bytes())
    return path
