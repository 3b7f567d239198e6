"""Correct the keypoints of keyframes for rolling shutters before the map is built from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from bodycap_batch.capture import Capture
from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
from bodycap_batch.mapping.intrinsics.readout_time import Readout, stated_readout
from bodycap_batch.model.rotation_fit import fit_rotation_path
from bodycap_batch.model.rotation_path import TurningShutter
from bodycap_batch.model.scene import KeyframeSelection, Map

_FOLDER = "shutters"
"""Name of the folder with the shutters, in the workspace folder. Each camera with a rolling shutter has a
file."""


def known_readouts(capture: Capture) -> dict[str, Readout]:
    """Return the readout times that are given in the job and are not 0, by camera name."""
    return {
        camera.name: replace(stated_readout(camera.rolling_shutter_s), sideways=camera.camera.sideways)
        for camera in capture.cameras
        if camera.rolling_shutter_known and camera.rolling_shutter_s
    }


def readouts_of_maps(maps: Sequence[Map]) -> dict[str, Readout]:
    """Return the readout times for which maps are corrected, by camera name."""
    out: dict[str, Readout] = {}
    for scene_map in maps:
        for name, seconds in scene_map.readout_s.items():
            sideways = name in scene_map.cameras and scene_map.cameras[name].sideways
            out.setdefault(name, Readout(seconds, 0.0, "of the map", seconds, sideways))
    return out


def turning_shutters(
    capture: Capture, selections: Sequence[KeyframeSelection], readouts: Mapping[str, Readout]
) -> dict[str, TurningShutter]:
    """Estimate the rotation of each camera with a rolling shutter, from matches between adjacent frames.

    Args:
        capture: All cameras.
        selections: The keyframes of the cameras, with the matches between adjacent frames.
        readouts: The readout times by camera name.

    Returns:
        The shutters by camera name. Cameras without matches or without a readout time have none.
    """
    out = {}
    for selection in selections:
        readout = readouts.get(selection.camera)
        if readout is None or not readout.seconds or selection.matches is None:
            continue
        camera = capture.camera(selection.camera)
        lens = replace(camera.camera, sideways=readout.sideways)
        path = fit_rotation_path(selection.matches, lens, camera.times_ns, readout.seconds)
        out[selection.camera] = TurningShutter(lens, path, readout.seconds)
    return out


def write_shutters(workspace: Path, shutters: Mapping[str, TurningShutter]) -> None:
    """Store shutters in a workspace. New keyframes are corrected with them when the map is extended."""
    folder = workspace / _FOLDER
    for name, shutter in sorted(shutters.items()):
        folder.mkdir(exist_ok=True)
        write_dataclass(shutter, folder, name)


def read_shutters(workspace: Path, names: Iterable[str]) -> dict[str, TurningShutter]:
    """Read the shutters of some cameras from a workspace, by camera name.

    Cameras without a stored shutter have no entry.
    """
    folder = workspace / _FOLDER
    return {
        name: read_dataclass(TurningShutter, folder, name)
        for name in names
        if (folder / f"{name}.json").exists()
    }
