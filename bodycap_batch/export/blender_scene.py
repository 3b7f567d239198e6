"""Collect what the script for Blender needs to know: rate, bones, cameras and unmeasured spans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.export.camera_animation import lens_of
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.export.take_time import take_of_motion
from bodycap_batch.export.target_frames import WORLD, trajectories_in_target_frames
from bodycap_batch.formats.bvh.axes import UNITS_PER_METRE
from bodycap_batch.model.bone_axes import bone_ends_m
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.measured_parts import filled_branches, joint_sources, part_spans
from bodycap_batch.model.scene import Trajectory
from bodycap_batch.model.skeleton import Motion, rest_pose


def collect_blender_scene(inputs: ExportInputs, motion: Motion, options: ExportOptions) -> dict[str, Any]:
    """Return the content of ``blender_scene.json`` as plain JSON values.

    Cameras that are not in the world are left out, and so are cameras without intrinsics.

    Args:
        inputs: The results of the earlier stages.
        motion: The motion in the layout of the files for animation.
        options: The export options.
    """
    cameras: dict[str, Any] = {}
    for path in trajectories_in_target_frames(inputs):
        lens = lens_of(inputs, path.camera)
        if path.gauge == WORLD and path.localised.any() and lens is not None:
            cameras[path.camera] = _camera(inputs, path, lens, motion)
    return {
        "name": "bodycap",
        **take_of_motion(inputs, motion).figures(),
        "frames": len(motion.root_in_world_m),
        "bvh_scale": 1.0 / UNITS_PER_METRE[options.units],
        "bones": _bones(motion),
        "cameras": cameras,
        "spans": [
            {"part": span.part, "state": span.state.value, "first": span.first, "last": span.last}
            for span in part_spans(motion)
        ],
    }


def _bones(motion: Motion) -> dict[str, Mapping[str, Any]]:
    """Return the length, the freedom to move and the source of the motion of each bone, by joint name."""
    skeleton = motion.skeleton
    lengths = np.linalg.norm(bone_ends_m(skeleton) - rest_pose(skeleton)[:, :3, 3], axis=1)
    share = motion.observed.mean(axis=0)
    free = 0 if motion.hips_in_root_m is None else 1
    sources, removable = joint_sources(motion), filled_branches(motion)
    return {
        name: {
            "length_m": round(float(lengths[joint]), 6),
            "moves_freely": joint <= free,
            "measured_share": round(float(share[joint]), 4),
            "source": sources[joint].value,
            "in_filled_layer": bool(removable[joint]),
        }
        for joint, name in enumerate(skeleton.joints)
    }


def _camera(inputs: ExportInputs, path: Trajectory, lens: Camera, motion: Motion) -> dict[str, Any]:
    """Return the lens and the clock of one camera.

    ``frame_at_start`` is the frame of the video at the first tick of the motion, and ``frames_per_tick`` the
    number of frames of the video for each tick.
    """
    clock = inputs.clocks[path.camera]
    common_s = clock.common_times_ns(path.times_ns) / 1e9
    ticks = (common_s - motion.start_ns / 1e9) * motion.fps
    several = len(ticks) > 1
    slope, first = np.polyfit(ticks, path.frame_numbers, 1) if several else (1.0, -float(ticks[0]))
    return {
        "width_px": lens.width_px,
        "height_px": lens.height_px,
        "model": lens.model,
        "focal_px": lens.focal_px,
        "centre_px": list(lens.principal_point_px),
        "offset_s": clock.offset_s,
        "clock_rate": 1.0 + 1e-6 * clock.drift_ppm,
        "frame_at_start": round(float(first), 4),
        "frames_per_tick": round(float(slope), 6),
    }
