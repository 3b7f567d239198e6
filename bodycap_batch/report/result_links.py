"""Describe each result file: what is in it, and which programs open it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import NamedTuple

_FILES = {
    "motion.bvh": ("the motion", "Blender, MotionBuilder, 3ds Max, retargeters"),
    "motion.glb": ("the motion with a mannequin", "Blender, Godot, three.js, web viewers"),
    "motion.fbx": ("the motion with a mannequin", "Maya, MotionBuilder, Unreal, Unity"),
    "motion.usd": ("the motion with a mannequin", "Omniverse, Houdini, usdview"),
    "blender_scene.py": (
        "builds body, room and cameras in Blender",
        "Blender 4.2 and later: tab Scripting, Run Script",
    ),
    "bodycap_blender.zip": ("the same script as an extension", "Blender 4.2 and later: Install from Disk"),
    "blender_scene.json": ("data of the script for Blender", "the script for Blender"),
    "joints.c3d": ("joint centres", "Mokka, Visual3D, Vicon and Qualisys tools"),
    "joints.trc": ("joint centres", "OpenSim"),
    "joints.csv": ("joint poses, and which were measured", "spreadsheets, pandas"),
    "joints.npz": ("joint poses, and which were measured", "NumPy"),
    "frames.csv": ("the status of every video frame", "spreadsheets, pandas"),
    "map.ply": ("the room as points, and the camera paths", "MeshLab, CloudCompare, Blender"),
    "cameras.glb": ("the animated cameras, and the room as points", "Blender, three.js, web viewers"),
    "cameras.usd": ("the animated cameras, and the room as points", "Omniverse, Houdini, Blender, usdview"),
    "cameras.fbx": ("the animated cameras", "Maya, MotionBuilder, Unreal, Unity"),
    "cameras.json": (
        "lens, picture size and frames of the animated cameras, rate and timecode",
        "any program that reads JSON",
    ),
    "metrics.json": ("all figures of this page", "any program that reads JSON"),
}
"""Content of each result file, and what opens it, by file name. The order is that of the page."""
_PATTERNS = {
    "*_far.ply": ("points that are far away: their depth is uncertain", "MeshLab, CloudCompare"),
    "map_*.ply": ("a map that could not be placed", "MeshLab"),
    "*.tum": ("the path of camera {stem}", "evo, any editor"),
    "*.chan": ("the animated camera {stem}", "Nuke"),
    "*.abc": ("the animated camera {stem}", "Nuke, Maya, Houdini, Blender"),
    "colmap/*/cameras.bin": ("a map as a COLMAP model", "COLMAP, nerfstudio"),
}
"""The same for files that a job can have several of, by pattern; the first pattern that matches counts."""


class ResultLink(NamedTuple):
    """A result file on the page.

    Attributes:
        path: Path of the file or folder, relative to the page.
        content: What is in it.
        opens_in: Programs that open it.
    """

    path: str
    content: str
    opens_in: str


def describe_files(paths: Iterable[str]) -> list[ResultLink]:
    """Return the result files with their descriptions; the files of a COLMAP model are one entry.

    Args:
        paths: Paths of the files, relative to the results folder.
    """
    names = sorted(paths)
    links = [ResultLink(name, *words) for name, words in _FILES.items() if name in names]
    for path in map(PurePosixPath, names):
        pattern = next((pattern for pattern in _PATTERNS if path.match(pattern)), None)
        if pattern is not None:
            content, opens_in = _PATTERNS[pattern]
            place = f"{path.parent}/" if path.parts[0] == "colmap" else str(path)
            links.append(ResultLink(place, content.format(stem=path.stem), opens_in))
    return links
