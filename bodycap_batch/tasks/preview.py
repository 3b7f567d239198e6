"""The task that renders the results as a video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bodycap_batch.capture import Capture
from bodycap_batch.core.context import StageContext
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.merge_data import MergeResult
from bodycap_batch.model.scene import Map
from bodycap_batch.model.skeleton_presets import split_side
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef, paths_of
from bodycap_batch.tasks.loading import load_capture, load_clocks, load_map, load_registration
from bodycap_batch.tasks.motion import load_motion
from bodycap_batch.tasks.registered_cameras import RegisteredCameras
from bodycap_batch.tasks.stage import RESULTS_FOLDER

if TYPE_CHECKING:
    from bodycap_batch.preview import PreviewInputs


@dataclass(frozen=True, slots=True, kw_only=True)
class PreviewTask:
    """Render the results as a video.

    Attributes:
        capture: The videos of all cameras.
        keyframes: The selected keyframes of each camera, by camera name.
        registrations: The registration of each camera, by camera name.
        map: The map.
        clocks: The clocks of all cameras.
        merge: The skeleton's motion; None if there is no motion.
        failure: The reason why the skeleton that the job asks for is missing; None if no skeleton is missing.
    """

    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    registrations: Mapping[str, ArtefactRef]
    map: ArtefactRef
    clocks: ArtefactRef
    merge: ArtefactRef | None
    failure: str | None


def run_preview(task: PreviewTask, context: StageContext, files: Path) -> None:
    """Render the video."""
    from bodycap_batch.preview import render_preview

    render_preview(_preview_inputs(task, files / RESULTS_FOLDER / "preview.mp4", context.threads), context)


def _preview_inputs(task: PreviewTask, path: Path, threads: int) -> PreviewInputs:
    from bodycap_batch.overlay import bones_from_motion, make_camera_views
    from bodycap_batch.preview import PreviewInputs

    scene = load_map(task.map.path)
    paths = paths_of(task.registrations.values())
    clocks = load_clocks(task.clocks.path)
    capture = load_capture(task.capture, task.keyframes, clocks=clocks, threads=threads)
    found = RegisteredCameras.load(paths, scene.maps, clocks)
    merge = None if task.merge is None else load_motion(task.merge)
    registrations = [load_registration(artefact) for artefact in paths]
    transforms = _transforms_of(scene.maps, merge)
    points = [transforms[item.gauge].apply(item.points) for item in scene.maps if item.gauge in transforms]
    colours = [item.colors for item in scene.maps if item.gauge in transforms]
    return PreviewInputs(
        path=path,
        capture=_trunk_first(capture, merge),
        views=make_camera_views(registrations, scene.maps, found.clocks, merge),
        reference_frame="world" if merge is not None else scene.maps[0].gauge,
        points=np.concatenate([np.zeros((0, 3)), *points]),
        colours=np.concatenate([np.zeros((0, 3), np.uint8), *colours]),
        bone_motion=None if merge is None else bones_from_motion(merge.motion),
        note=task.failure or "",
    )


def _transforms_of(maps: Sequence[Map], merge: MergeResult | None) -> dict[str, Similarity]:
    """Return the transform of each map that the preview shows, by the name of the map's gauge.

    With a motion, these are the transforms of all maps that merging placed in the world. Without a motion,
    only the largest map is shown, untransformed.
    """
    if merge is not None:
        return dict(merge.world_from_map)
    return {maps[0].gauge: Similarity(1.0, np.eye(3), np.zeros(3))}


def _trunk_first(capture: Capture, merge: MergeResult | None) -> Capture:
    """Return the capture with its cameras sorted: first on the trunk, then on limbs, then the unused cameras.

    The preview shows the cameras on the trunk largest.
    """
    if merge is None:
        return capture
    limb = {mount.camera: split_side(mount.role)[0] != "" for mount in merge.mounts}
    order = sorted(capture.cameras, key=lambda camera: (camera.name not in limb, limb.get(camera.name)))
    return replace(capture, cameras=tuple(order))
