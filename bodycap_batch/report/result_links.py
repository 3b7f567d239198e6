"""Describe each result file: what is in it, and which programs open it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import PurePosixPath

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


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultLink:
    """A result file on the page.

    Attributes:
        path: Path of the file, relative to the page.
        content: What is in the file.
        opens_in: Programs that open it.
    """

    path: str
    content: str
    opens_in: str


def describe_files(paths: Iterable[str]) -> list[ResultLink]:
    """Return the result files with their descriptions; files of one kind in folders are one entry.

    Args:
        paths: Paths of the files, relative to the results folder.
    """
    names = sorted(paths)
    out = [
        ResultLink(path=name, content=content, opens_in=programs)
        for name, (content, programs) in _FILES.items()
        if name in names
    ]
    for name in names:
        folder = PurePosixPath(name)
        if folder.stem.endswith("_far") and folder.suffix == ".ply":
            content = "points that are far away: their depth is uncertain"
            out.append(ResultLink(path=name, content=content, opens_in="MeshLab, CloudCompare"))
        elif name.startswith("map_") and folder.suffix == ".ply":
            out.append(ResultLink(path=name, content="a map that could not be placed", opens_in="MeshLab"))
        elif folder.suffix == ".tum":
            out.append(
                ResultLink(path=name, content=f"the path of camera {folder.stem}", opens_in="evo, any editor")
            )
        elif folder.suffix in (".chan", ".abc"):
            opens_in = "Nuke" if folder.suffix == ".chan" else "Nuke, Maya, Houdini, Blender"
            out.append(ResultLink(path=name, content=f"the animated camera {folder.stem}", opens_in=opens_in))
        elif folder.parts[0] == "colmap" and folder.name == "cameras.bin":
            out.append(
                ResultLink(
                    path=f"{folder.parent}/", content="a map as a COLMAP model", opens_in="COLMAP, nerfstudio"
                )
            )
    return out
