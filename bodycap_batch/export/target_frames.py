"""Which frame each map and each trajectory is written in: the world where merging placed it."""

from __future__ import annotations

from dataclasses import dataclass

from bodycap_batch.export.export_inputs import ExportInputs
from bodycap_batch.model.geometry import Similarity
from bodycap_batch.model.scene import Map, Trajectory

WORLD = "world"


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportedMap:
    """A map and the frame it is written in.

    Attributes:
        scene: The map in its own gauge.
        frame: "world", or its gauge's name.
        target_from_map: Into that frame; None for the identity.
    """

    scene: Map
    frame: str
    target_from_map: Similarity | None


def maps_in_target_frames(inputs: ExportInputs) -> tuple[ExportedMap, ...]:
    """All maps, the world's first; each group largest first."""
    placements = {} if inputs.merge is None else inputs.merge.world_from_map
    placed = [
        ExportedMap(
            scene=scene,
            frame=WORLD if scene.gauge in placements else scene.gauge,
            target_from_map=placements.get(scene.gauge),
        )
        for scene in inputs.maps
    ]
    return tuple(sorted(placed, key=lambda item: item.frame != WORLD))


def trajectories_in_target_frames(inputs: ExportInputs) -> tuple[Trajectory, ...]:
    """Every camera's trajectory: merging's in the world where there is one, else in its map's gauge."""
    merged = {} if inputs.merge is None else {item.camera: item for item in inputs.merge.trajectories}
    return tuple(merged.get(item.camera, item) for item in inputs.trajectories)


def main_target_name(inputs: ExportInputs) -> str:
    """The frame of the results: the world, else the largest map's gauge."""
    placed = maps_in_target_frames(inputs)
    return placed[0].frame if placed else WORLD
