"""The task that films the results."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.loading import load_capture, load_map, load_registration
from bodycap_batch.tasks.registered import Registered
from bodycap_batch.tasks.stage import RESULTS, SEEING, VISION, Json, Stage

if TYPE_CHECKING:
    from collections.abc import Sequence

    from bodycap_batch.capture import Capture
    from bodycap_batch.model.geometry import Similarity
    from bodycap_batch.model.merge_data import MergeResult
    from bodycap_batch.model.scene import Map
    from bodycap_batch.preview import PreviewInputs


def _preview(_: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.preview import render_preview

    render_preview(_inputs(arguments, files / RESULTS / "preview.mp4"), context)


def _inputs(arguments: Json, path: Path) -> PreviewInputs:
    import numpy as np

    from bodycap_batch.export import project_motion
    from bodycap_batch.formats.bundle import read_bundle
    from bodycap_batch.model.merge_data import MergeResult
    from bodycap_batch.overlay import bones_from_motion, make_camera_views
    from bodycap_batch.preview import PreviewInputs

    scene = load_map(arguments["map"])
    found = Registered.load(arguments["registrations"], scene.maps)
    merged = arguments["merge"]
    merge = None if merged is None else read_bundle(MergeResult, Path(merged), "merge")
    registrations = [load_registration(path) for path in arguments["registrations"]]
    shown = _shown(scene.maps, merge)
    moved = [shown[item.gauge].apply(item.points) for item in scene.maps if item.gauge in shown]
    colours = [item.colors for item in scene.maps if item.gauge in shown]
    return PreviewInputs(
        path=path,
        capture=_trunk_first(load_capture(arguments), merge),
        views=make_camera_views(registrations, scene.maps, found.clocks, merge),
        reference_frame="world" if merge is not None else scene.maps[0].gauge,
        points=np.concatenate(moved),
        colours=np.concatenate(colours),
        bone_motion=None
        if merge is None
        else bones_from_motion(project_motion(merge, found.clocks, found.row_fraction).motion),
        note=arguments["failure"] or "",
    )


def _shown(maps: Sequence[Map], merge: MergeResult | None) -> dict[str, Similarity]:
    """Where the maps stand that are in the room: those that merging placed, else the largest alone."""
    import numpy as np

    from bodycap_batch.model.geometry import Similarity

    if merge is not None:
        return dict(merge.world_from_map)
    return {maps[0].gauge: Similarity(1.0, np.eye(3), np.zeros(3))}


def _trunk_first(capture: Capture, merge: MergeResult | None) -> Capture:
    """The trunk's cameras, which see the arms, come first and are shown largest; those of nobody last."""
    from dataclasses import replace

    from bodycap_batch.model.skeleton_presets import split_side

    if merge is None:
        return capture
    limb = {mount.camera: split_side(mount.role)[0] != "" for mount in merge.mounts}
    order = sorted(capture.cameras, key=lambda camera: (camera.name not in limb, limb.get(camera.name)))
    return replace(capture, cameras=tuple(order))


PREVIEW = Stage(
    function=_preview,
    libraries=(*VISION, "scipy", "pycolmap"),
    modules=(*SEEING, "bodycap_batch.export", "bodycap_batch.preview", "pycolmap", "scipy.spatial.transform"),
)
