"""The stage's own account of itself, as plain JSON values."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.merging.body_calibration.calibrate_body import BodyCalibration
from bodycap_batch.merging.body_calibration.scale import ScaleSource, chi_square
from bodycap_batch.merging.cameras.clock_check import doubted_clocks
from bodycap_batch.merging.cameras.side_check import exchanged_sides
from bodycap_batch.merging.cameras.track import Track
from bodycap_batch.merging.graph.motion_graph import Solution
from bodycap_batch.merging.reporting.advice import (
    describe_clock,
    describe_hinge,
    describe_mount,
    describe_scale,
    describe_swapped_sides,
    describe_vertical,
)
from bodycap_batch.merging.world.vertical import apart_deg
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.merge_data import MergeInputs


def build_report(
    inputs: MergeInputs,
    calibrated: BodyCalibration,
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
        notes: ``dropped`` frames by camera, the ``floor``, the ``unused`` and the ``joined`` cameras,
            ``joint_gap_m`` and ``hinge_m`` and ``uncertainty`` by role, how far the ``rules`` were pressed,
            the feet's ``contacts``,
            and ``start_ns`` and ``end_ns``, the first
            and the last tick.
    """
    floor = notes["floor"]
    return {
        "scale": _scale(calibrated),
        "t_pose": _t_pose(calibrated, notes["start_ns"]),
        "up": _up(calibrated),
        "floor": {"source": floor.source, "points": floor.support},
        "mounts": {mount.camera: _mount(inputs, mount.camera, calibrated) for mount in calibrated.mounts},
        "cameras": {
            track.camera: {
                "measurements": len(track.times_ns),
                "dropped_as_gross_errors": len(notes["dropped"][track.camera]),
                "down_weighted": int((solution.weights[track.camera] < 0.25).sum()),
                "residual_m": _percentiles(solution.residual_m[track.camera]),
                "residual_deg": _percentiles(np.degrees(solution.residual_rad[track.camera])),
                "longest_gap_s": longest_gap_s(track, notes["start_ns"], notes["end_ns"]),
            }
            for track in tracks
        },
        "doubted_clocks": _clocks(inputs, [each for each in tracks if each.camera not in notes["joined"]]),
        "exchanged_sides": _sides(inputs, calibrated, tracks, notes["joined"]),
        "unused_cameras": dict(notes["unused"]),
        "joined_cameras": notes["joined"],
        "joint_gap_m": {role: _percentiles(gap) for role, gap in notes["joint_gap_m"].items()},
        "joint_sigma_m": notes["uncertainty"],
        "hinge_off_plane_m": {role: _percentiles(off) for role, off in notes["hinge_m"].items()},
        "loose_hinges": {
            role: {"sigma_m": round(off_m, 5), "known_to": describe_hinge(role, off_m)}
            for role, off_m in calibrated.off_hinge_m.items()
        },
        "activity": {
            "name": inputs.activity,
            "rules_active": {name: float((off > 0.0).mean()) for name, off in notes["rules"].items()},
            "rules_pressed_m": {
                name: _percentiles(off[off > 0.0])
                for name, off in notes["rules"].items()
                if (off > 0.0).any()
            },
        },
        "foot_contact": notes["contacts"],
        "solver": {
            "ticks": len(solution.world_from_bone),
            "bones": solution.world_from_bone.shape[1],
            "iterations": solution.iterations,
            "half_squared_error": {kind: round(error, 4) for kind, error in solution.errors.items()},
        },
    }


def _clocks(inputs: MergeInputs, tracks: Sequence[Track]) -> dict[str, Any]:
    """Cameras whose clock is doubted, and the ``offset_s`` that would suit them; none of joined maps."""
    out: dict[str, Any] = {}
    for camera, doubt in doubted_clocks(tracks).items():
        offset_s = round(inputs.clocks[camera].offset_s + doubt["shift_s"], 2)
        out[camera] = {**doubt, "offset_s": offset_s, "says": describe_clock(camera, doubt, offset_s)}
    return out


def _sides(
    inputs: MergeInputs, calibrated: BodyCalibration, tracks: Sequence[Track], joined: Collection[str]
) -> dict[str, Any]:
    """Limbs' cameras on the other side of the body, where all are; nothing of joined maps."""
    own = [each for each in tracks if each.camera not in joined]
    mounts = {mount.camera: mount for mount in (*inputs.mounts, calibrated.reference_prior)}
    wrong = exchanged_sides(own, mounts, calibrated.vertical.up)
    return {"cameras": wrong, "says": describe_swapped_sides(wrong)} if wrong else {}


def _scale(calibrated: BodyCalibration) -> dict[str, Any]:
    """The scale, everything that knows it, and how far all of that disagrees."""
    chi2, freedom = chi_square(calibrated.scale.sources)
    out: dict[str, Any] = {
        "source": " and ".join(source.name for source in calibrated.scale.sources if source.used),
        "metres_per_map_unit": calibrated.scale.metres_per_unit,
        "relative_sigma": round(calibrated.scale.sigma_log, 5),
        "sources": [_source(source, calibrated.scale.metres_per_unit) for source in calibrated.scale.sources],
        "chi2": round(chi2, 3),
        "degrees_of_freedom": freedom,
        "body_alone": {
            "metres_per_map_unit": calibrated.bones_alone.scale,
            "relative_sigma": round(calibrated.bones_alone.sigma_log, 5),
            "costs": [[scale, round(cost, 4)] for scale, cost in calibrated.bones_alone.costs],
        },
        "trunk_over_floor_m": calibrated.height_over_floor_m,
        "known_to": describe_scale(calibrated),
    }
    if calibrated.limbs:
        chi2, freedom = chi_square(calibrated.limbs)
        out["limbs"] = {
            "alone": [_source(limb, calibrated.scale.metres_per_unit) for limb in calibrated.limbs],
            "chi2": round(chi2, 3),
            "degrees_of_freedom": freedom,
        }
    return out


def _up(calibrated: BodyCalibration) -> dict[str, Any]:
    """What up was taken from, and how far off everything else is."""
    up = calibrated.vertical
    return {
        "source": up.source,
        "sigma_deg": round(up.sigma_deg, 2),
        "body_off_deg": None if up.body_off_deg is None else round(up.body_off_deg, 3),
        "plane_points_share": round(up.plane_share, 3),
        "others": [
            {
                "name": say.source,
                "off_deg": round(apart_deg(say.up, up.up), 2),
                "sigma_deg": round(say.sigma_deg, 2),
                "less_likely_nats": round(say.nats - up.nats, 2),
            }
            for say in up.others
        ],
        "known_to": describe_vertical(calibrated),
    }


def _source(source: ScaleSource, scale: float) -> dict[str, Any]:
    return {
        "name": source.name,
        "metres_per_map_unit": source.scale,
        "relative_sigma": round(source.sigma_log, 5),
        "off": round(float(np.log(source.scale / scale)), 5),
        "used": source.used,
    }


def _t_pose(calibrated: BodyCalibration, start_ns: int) -> dict[str, float] | None:
    """From when to when a T-pose stands, seconds from the first tick."""
    if calibrated.t_pose_ns is None:
        return None
    first, last = (round(1e-9 * (time - start_ns), 3) for time in calibrated.t_pose_ns)
    return {"from_s": first, "to_s": last}


def _mount(inputs: MergeInputs, camera: str, calibrated: BodyCalibration) -> dict[str, Any]:
    solved = next(mount for mount in calibrated.mounts if mount.camera == camera)
    prior = inputs.mount_of(camera)
    turned = prior.joint_from_cam[:3, :3].T @ solved.joint_from_cam[:3, :3]
    moved = solved.joint_from_cam[:3, 3] - prior.joint_from_cam[:3, 3]
    return {
        "role": solved.role,
        **_roll(calibrated, camera),
        "joint_from_cam": solved.joint_from_cam.tolist(),
        "sigma_deg": round(float(np.degrees(solved.sigma_rad)), 3),
        "sigma_m": round(solved.sigma_m, 5),
        "from_prior_deg": round(float(np.degrees(rotation_angle_rad(turned))), 3),
        "from_prior_m": round(float(np.linalg.norm(moved)), 5),
        "known_to": describe_mount(solved, t_pose=calibrated.t_pose_ns is not None),
    }


def _roll(calibrated: BodyCalibration, camera: str) -> dict[str, Any]:
    """Which way up the camera sits, and how much worse the next best way explains its motion."""
    search = next((each for each in calibrated.rolls if each.camera == camera), None)
    if search is None:
        return {}
    roll, cost = search.runner_up()
    return {
        "roll_deg": search.chosen_deg,
        "roll_runner_up": {"roll_deg": roll, "half_squared_sigmas_more": round(cost, 2)},
    }


def _percentiles(values: FloatArray) -> dict[str, float]:
    return {f"p{q}": round(float(np.percentile(values, q)), 5) for q in (50, 95)}


def longest_gap_s(track: Track, start_ns: int, end_ns: int) -> float:
    """Longest time without a measurement; that before the first one and after the last one count, too."""
    times = np.concatenate([[start_ns], np.clip(track.times_ns, start_ns, end_ns), [end_ns]])
    return round(float(np.diff(times).max()) * 1e-9, 4)
