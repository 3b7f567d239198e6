"""The stage's own account of itself, as plain JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bodycap_batch.arrays import FloatArray
from bodycap_batch.body import MergeInputs
from bodycap_batch.geometry import rotation_angle_rad
from bodycap_batch.merging.scale import Calibrated
from bodycap_batch.merging.solve import Solution
from bodycap_batch.merging.tracks import Track


def build_report(
    inputs: MergeInputs,
    calibrated: Calibrated,
    solution: Solution,
    tracks: Sequence[Track],
    notes: Mapping[str, Any],
) -> dict[str, Any]:
    """Collect sources, values and residuals.

    Args:
        inputs: What came in.
        calibrated: Scale, mounts and up.
        solution: The solved motion.
        tracks: The tracks that were used.
        notes: ``dropped`` frames by camera, the ``floor``, the ``unused`` cameras, ``joint_gap_m`` and
            ``uncertainty`` by role and how often the activity's ``rules`` were active.
    """
    floor = notes["floor"]
    return {
        "scale": _scale(inputs, calibrated),
        "up": {
            "source": calibrated.up.source,
            "body_off_deg": None
            if calibrated.up.body_off_deg is None
            else round(calibrated.up.body_off_deg, 3),
            "plane_points_share": round(calibrated.up.plane_share, 3),
        },
        "floor": {"source": floor.source, "points": floor.support},
        "mounts": {mount.camera: _mount(inputs, mount.camera, calibrated) for mount in calibrated.mounts},
        "cameras": {
            track.camera: {
                "measurements": len(track.times_ns),
                "dropped_as_gross_errors": notes["dropped"][track.camera],
                "down_weighted": int((solution.weights[track.camera] < 0.25).sum()),
                "residual_m": _percentiles(solution.residual_m[track.camera]),
                "residual_deg": _percentiles(np.degrees(solution.residual_rad[track.camera])),
                "longest_gap_s": _longest_gap_s(track),
            }
            for track in tracks
        },
        "unused_cameras": dict(notes["unused"]),
        "joint_gap_m": {role: _percentiles(gap) for role, gap in notes["joint_gap_m"].items()},
        "joint_sigma_m": notes["uncertainty"],
        "activity": {"name": inputs.activity, "rules_active": notes["rules"]},
        "solver": {
            "ticks": len(solution.world_from_bone),
            "bones": solution.world_from_bone.shape[1],
            "iterations": solution.iterations,
            "half_squared_error": {kind: round(error, 4) for kind, error in solution.errors.items()},
        },
    }


def _scale(inputs: MergeInputs, calibrated: Calibrated) -> dict[str, Any]:
    if inputs.skeleton_is_measured:
        source = "skeleton"
    else:
        source = "mean stature" if inputs.height_m is None else "height"
    return {
        "source": source,
        "metres_per_map_unit": calibrated.scale,
        "relative_sigma": round(calibrated.sigma_log, 5),
        "body_alone": {
            "metres_per_map_unit": calibrated.estimate.scale,
            "relative_sigma": round(calibrated.estimate.sigma_log, 5),
            "costs": [[scale, round(cost, 4)] for scale, cost in calibrated.estimate.costs],
        },
        "floor": {
            "believed": calibrated.floor_believed,
            "trunk_over_floor_m": calibrated.height_over_floor_m,
        },
    }


def _mount(inputs: MergeInputs, camera: str, calibrated: Calibrated) -> dict[str, Any]:
    solved = next(mount for mount in calibrated.mounts if mount.camera == camera)
    prior = inputs.mount_of(camera)
    turned = prior.joint_from_cam[:3, :3].T @ solved.joint_from_cam[:3, :3]
    moved = solved.joint_from_cam[:3, 3] - prior.joint_from_cam[:3, 3]
    return {
        "role": solved.role,
        "joint_from_cam": solved.joint_from_cam.tolist(),
        "sigma_deg": round(float(np.degrees(solved.sigma_rad)), 3),
        "sigma_m": round(solved.sigma_m, 5),
        "from_prior_deg": round(float(np.degrees(rotation_angle_rad(turned))), 3),
        "from_prior_m": round(float(np.linalg.norm(moved)), 5),
    }


def _percentiles(values: FloatArray) -> dict[str, float]:
    return {f"p{q}": round(float(np.percentile(values, q)), 5) for q in (50, 95)}


def _longest_gap_s(track: Track) -> float:
    return round(float(np.diff(track.times_ns).max(initial=0)) * 1e-9, 4)
