"""Choose the target frame: the frame of reference in which a map or a trajectory is exported.

The target frame is the world if merging aligned the map with the body. Otherwise it is the map's own gauge.
"""

from __future__ import annotations

from dataclasses import dataclass

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.scene import Map, Trajectory

WORLD = "world"
"""Name of the world as a target frame. The name of any other target frame is the identifier of a gauge."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportedMap:
    """A map and the frame of reference in which it is exported.

    Attributes:
        scene: The map in its own gauge.
        target: Name of the target frame: "world", or the identifier of the map's gauge.
        target_from_map: Transform from the map's gauge to the target frame; None for the identity.
    """

    scene: Map
    target: str
    target_from_map: Similarity | None

    def points(self) -> FloatArray:
        """Return the points (P,3) of the map in its target frame."""
        points = self.scene.points
        return points if self.target_from_map is None else self.target_from_map.apply(points)


def describe_target(target: str) -> str:
    """Return the unit and the axes of a target frame, as words for the header of a file."""
    if target == WORLD:
        return "metres, Z up, floor at z = 0"
    return f"gauge {target}, its scale and axes are arbitrary"


def maps_in_target_frames(inputs: ExportInputs) -> tuple[ExportedMap, ...]:
    """Return all maps with their target frames.

    Maps in the world come first, then all other maps. Each of these two groups is sorted by size, with the
    largest map first.
    """
    world_from_map = {} if inputs.merge is None else inputs.merge.world_from_map
    exported = [
        ExportedMap(
            scene=scene,
            target=WORLD if scene.gauge in world_from_map else scene.gauge,
            target_from_map=world_from_map.get(scene.gauge),
        )
        for scene in inputs.maps
    ]
    return tuple(sorted(exported, key=lambda item: item.target != WORLD))


def trajectories_in_target_frames(inputs: ExportInputs) -> tuple[Trajectory, ...]:
    """Return the trajectory of each camera in its target frame.

    The trajectory is in the world if merging placed the camera there. Otherwise it is in the gauge of the
    camera's map.
    """
    merged = {} if inputs.merge is None else {path.camera: path for path in inputs.merge.trajectories}
    return tuple(merged.get(path.camera, path) for path in inputs.trajectories)


def main_target_name(inputs: ExportInputs) -> str:
    """Return the name of the main target frame.

    The main target frame is the world if at least one map is in the world, or if there are no maps. Otherwise
    it is the gauge of the largest map.
    """
    exported = maps_in_target_frames(inputs)
    return exported[0].target if exported else WORLD


def target_numbers(inputs: ExportInputs) -> dict[str, int]:
    """Return the number of each target frame, by its name. The main target frame has the number 0."""
    names = (item.target for item in maps_in_target_frames(inputs))
    return {name: number for number, name in enumerate(dict.fromkeys(names))}
