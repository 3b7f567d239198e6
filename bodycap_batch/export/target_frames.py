"""The frame of reference in which each map and each trajectory is exported.

It is the world if merging has aligned the map with the body, else the map's own gauge.
"""

from __future__ import annotations

from dataclasses import dataclass

from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.scene import Map, Trajectory

WORLD = "world"
"""Name of the world as a target frame. Other targets have the identifier of a gauge."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportedMap:
    """A map and the frame of reference in which it is exported.

    Attributes:
        scene: The map in its own gauge.
        target: Name of the target frame: "world", or the identifier of the map's gauge.
        target_from_map: Transform to the target frame; None for the identity.
    """

    scene: Map
    target: str
    target_from_map: Similarity | None


def maps_in_target_frames(inputs: ExportInputs) -> tuple[ExportedMap, ...]:
    """Return all maps with their target frames: first those in the world, then the others.

    Within each group, the largest map comes first.
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
    """Return each camera's trajectory: in the world if merging has it, else in its map's gauge."""
    merged = {} if inputs.merge is None else {path.camera: path for path in inputs.merge.trajectories}
    return tuple(merged.get(path.camera, path) for path in inputs.trajectories)


def main_target_name(inputs: ExportInputs) -> str:
    """Return the name of the main target frame: the world if it exists, else the largest map's gauge."""
    exported = maps_in_target_frames(inputs)
    return exported[0].target if exported else WORLD
