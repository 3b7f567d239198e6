"""The task that finds where the wearer's body is in the pictures of each camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import ArtefactRef, paths_of
from bodycap_batch.tasks.loading import load_clocks, load_map, wearer_name
from bodycap_batch.tasks.registered_cameras import RegisteredCameras
from bodycap_batch.tasks.stage import Stage, write_summary

if TYPE_CHECKING:
    from bodycap_batch.core.arrays import FloatArray
    from bodycap_batch.model.scene import Map
    from bodycap_batch.model.wearer_view import WearerView

_MIN_SHARE = 0.15
"""Minimum share of the body in the pictures of a camera that is masked: the mean over all frames in which the
place of the body is known. Evidence: docs/decisions/registration.md."""
_MAX_SEEN_THROUGH = 0.5
"""Maximum density of the map's observations where the body is predicted, as a ratio of the density elsewhere
in the pictures. A body hides the room: if the room is seen there, the body is somewhere else. Evidence:
docs/decisions/registration.md."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WearerTask:
    """Find where the wearer's body is in the pictures of each camera.

    The artefact holds a `WearerView` of each camera that is masked: the body covers much of its pictures, and
    hides the room there.

    Attributes:
        map: The map.
        registrations: The registration of each camera, by camera name.
        clocks: The clocks of all cameras.
        merge: The skeleton's motion, with the joints that no camera measured.
    """

    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]
    clocks: ArtefactRef
    merge: ArtefactRef


def run_wearer(task: WearerTask, context: StageContext, files: Path) -> None:
    """Predict the body in the pictures, and store the cameras in which it covers much."""
    from bodycap_batch.formats.dataclass_files import read_dataclass, write_dataclass
    from bodycap_batch.model.merge_data import MergeResult
    from bodycap_batch.overlay.wearer_prediction import predict_wearer_view

    maps = {item.gauge: item for item in load_map(task.map.path).maps}
    found = RegisteredCameras.load(
        paths_of(task.registrations.values()), list(maps.values()), load_clocks(task.clocks)
    )
    merge = read_dataclass(MergeResult, task.merge.path, "merge")
    in_world = {path.camera: path for path in merge.trajectories}
    views, shares, seen_through = {}, {}, {}
    for path in found.trajectories:
        context.check_cancelled()
        if path.camera not in in_world or path.gauge not in maps:
            continue
        common_ns = found.clocks[path.camera].common_times_ns(path.times_ns)
        lens, poses = maps[path.gauge].cameras[path.camera], in_world[path.camera].gauge_from_cam
        view = predict_wearer_view(merge, path.camera, lens, common_ns, poses)
        share = view.share()
        covered = share[view.is_known]
        shares[path.camera] = round(float(covered.mean()), 4) if len(covered) else 0.0
        if shares[path.camera] > _MIN_SHARE:
            seen_through[path.camera] = round(_seen_through(view, share, maps[path.gauge]), 4)
            if seen_through[path.camera] <= _MAX_SEEN_THROUGH:
                views[path.camera] = view
    for camera, view in views.items():
        write_dataclass(view, files, wearer_name(camera))
    write_summary(files, shares=shares, seen_through=seen_through, masked=sorted(views))


def _seen_through(view: WearerView, share: FloatArray, scene: Map) -> float:
    """Return the density of a map's observations where the body is, as a ratio of the density elsewhere.

    Args:
        view: The predicted body in the pictures of a camera.
        share: (N,) share of each picture that the body covers.
        scene: The map in which the camera has keyframes.
    """
    is_own = np.array(scene.keyframe_camera) == view.camera
    used = is_own & view.is_known[np.where(is_own, scene.keyframe_frame, 0)]
    area = float(share[scene.keyframe_frame[used]].mean()) if used.any() else 0.0
    own = used[scene.obs_keyframe]
    inside = view.covers(scene.obs_px[own], scene.keyframe_frame[scene.obs_keyframe[own]])
    if not inside.any() or not area:
        return 0.0
    return float(inside.mean() * (1.0 - area) / max(1.0 - inside.mean(), 1e-9) / area)


WEARER = Stage(
    name="wearer",
    task=WearerTask,
    function=run_wearer,
    libraries=("numpy", "scipy", "pycolmap"),
    modules=("bodycap_batch.overlay", "pycolmap"),
)
