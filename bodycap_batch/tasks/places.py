"""The task that finds from the motion which camera was at which place on the body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.inputs import ArtefactRef
from bodycap_batch.tasks.loading import load_clocks, load_registration
from bodycap_batch.tasks.stage import write_summary


@dataclass(frozen=True, slots=True, kw_only=True)
class PlacesTask:
    """Find from the motion which camera was at which place on the body.

    The motion often gives the clocks only if it is known which camera was on the trunk. If a clock is
    unknown, there is therefore one hypothesis for each camera.

    The summary holds ``places``, the place of each camera, and ``reason``, why they are not known.

    Attributes:
        stated: The place of each camera whose place is known, by camera name.
        clocks: The clocks of all cameras, by name of the camera that is taken for the one on the trunk; "" if
            the clocks need no such hypothesis.
        registrations: The registration of each camera, by camera name.
    """

    stated: Mapping[str, str]
    clocks: Mapping[str, ArtefactRef]
    registrations: Mapping[str, ArtefactRef]


def run_places(task: PlacesTask, _: StageContext, files: Path) -> None:
    """Find the places, and store them in the summary."""
    from bodycap_batch.camera_places import FoundPlaces, find_places_with

    paths = [load_registration(artefact.path).trajectory for artefact in task.registrations.values()]
    if len({path.gauge for path in paths}) > 1:
        found = FoundPlaces(by_camera={}, reason="the cameras are not in one map")
    else:
        clocks = {trunk: load_clocks(artefact.path).cameras for trunk, artefact in task.clocks.items()}
        found = find_places_with(clocks, paths, task.stated)
    text = ", ".join(f"{name} on {place}" for name, place in found.by_camera.items())
    notes = [f"places found from the motion: {text}"] if text else []
    write_summary(files, places=dict(found.by_camera), reason=found.reason, notes=notes)
