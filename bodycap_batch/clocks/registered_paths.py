"""Measure the clocks of cameras from their registered trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from bodycap_batch.clocks.motion_offsets import MotionClocks, motion_clocks
from bodycap_batch.clocks.motion_signals import CameraPath
from bodycap_batch.model.scene import Trajectory


def clocks_from_paths(
    trajectories: Sequence[Trajectory], roles: Mapping[str, str], reference: str
) -> MotionClocks:
    """Measure the clocks of cameras from their registered trajectories.

    Args:
        trajectories: The trajectory of each camera, on its own clock.
        roles: Role of the bone that each camera is mounted on, by camera name; "" if it is unknown.
        reference: Name of the reference camera. Cameras in other maps have no clock.
    """
    gauges = {path.camera: path.gauge for path in trajectories}
    same_map = [path for path in trajectories if path.gauge == gauges.get(reference)]
    paths = [
        CameraPath(
            camera=path.camera,
            role=roles.get(path.camera, ""),
            times_ns=path.times_ns[path.localised],
            map_from_cam=path.gauge_from_cam[path.localised],
        )
        for path in same_map
    ]
    found = motion_clocks(paths, reference)
    others = {name for name, gauge in gauges.items() if gauge != gauges.get(reference)}
    separate = dict.fromkeys(others, f"its map has no place in common with that of {reference}")
    return replace(found, reasons={**found.reasons, **separate})
