"""The task that finds from the motion which camera was at which place on the body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import ArtefactRef
from bodycap_batch.tasks.loading import load_clocks, load_registration
from bodycap_batch.tasks.stage import Stage, write_summary


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacesTask:
    """Find from the motion which camera was at which place on the body.

    The summary holds ``places``, the place of each camera, and ``reason``, why they are not known.

    Attributes:
        stated: The place of each camera whose place is known, by camera name.
        clocks: The clocks of all cameras.
        registrations: The registration of each camera, by camera name.
    """

    stated: Mapping[str, str]
    clocks: ArtefactRef
    registrations: Mapping[str, ArtefactRef]


def run_places(task: PlacesTask, context: StageContext, files: Path) -> None:
    """Find the places, and store them in the summary."""
    from bodycap_batch.camera_places import FoundPlaces, TimedPoses, find_places

    context.check_cancelled()
    clocks = load_clocks(task.clocks).cameras
    paths = [load_registration(artefact.path).trajectory for artefact in task.registrations.values()]
    unknown = [path.camera for path in paths if not clocks[path.camera].is_known]
    if unknown:
        found = FoundPlaces(by_camera={}, reason=f"the clock of {', '.join(unknown)} is unknown")
    elif len({path.gauge for path in paths}) > 1:
        found = FoundPlaces(by_camera={}, reason="the cameras are not in one map")
    else:
        poses = {
            path.camera: TimedPoses(
                common_ns=clocks[path.camera].common_ns(path.times_ns[path.localised]),
                map_from_cam=path.gauge_from_cam[path.localised],
            )
            for path in paths
        }
        found = find_places(poses, task.stated)
    text = ", ".join(f"{name} on {place}" for name, place in found.by_camera.items())
    notes = [f"places found from the motion: {text}"] if text else []
    write_summary(files, places=dict(found.by_camera), reason=found.reason, notes=notes)


PLACES = Stage(
    name="places",
    task=PlacesTask,
    function=run_places,
    libraries=("numpy", "scipy"),
    modules=("bodycap_batch.camera_places",),
)
