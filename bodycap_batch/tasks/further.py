"""The tasks that map the lost parts of the videos, and localise their frames in these further maps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from bodycap_batch.config.options import MapOptions, RegistrationOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.mechanisms import Mechanism, record_act
from bodycap_batch.formats.dataclass_files import write_dataclass
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef
from bodycap_batch.tasks.loading import load_capture, load_keyframes, load_map, load_registration
from bodycap_batch.tasks.mapping import save_map
from bodycap_batch.tasks.registered_cameras import OTHER_PATHS, replace_registration
from bodycap_batch.tasks.registration import NOT_ROUNDS


@dataclass(frozen=True, slots=True, kw_only=True)
class FurtherMapsTask:
    """Build maps of the parts of the videos that no path contains.

    Attributes:
        options: The options of the stage `map`.
        capture: The videos of all cameras.
        keyframes: The selected keyframes of each camera, by camera name.
        map: The map with the paths.
        registrations: The registration of each camera, by camera name.
    """

    options: MapOptions
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]


@dataclass(frozen=True, slots=True, kw_only=True)
class FurtherPosesTask:
    """Localise the lost frames of one camera in further maps.

    Attributes:
        options: The options of the stage `registration`.
        capture: The video of the camera.
        keyframes: The camera's selected keyframes, by camera name (one entry).
        map: All maps, with the further maps.
        registration: The camera's registration.
    """

    options: RegistrationOptions = field(metadata=NOT_ROUNDS)
    capture: CaptureRef
    keyframes: Mapping[str, ArtefactRef]
    map: ArtefactRef
    registration: ArtefactRef


def run_further_maps(task: FurtherMapsTask, context: StageContext, files: Path) -> None:
    """Build the further maps; store them with the maps to which the paths refer."""
    from bodycap_batch.mapping import map_lost_keyframes

    previous = load_map(task.map.path)
    # A generator loads one registration at a time: the tracks of a long video need much memory.
    paths = (load_registration(artefact.path).trajectory for artefact in task.registrations.values())
    capture = load_capture(task.capture, task.keyframes, threads=context.threads)
    result = map_lost_keyframes(capture, previous, list(paths), task.options, context)
    record_act(Mechanism.FURTHER_MAPS, len(result.log["further_maps"]))
    save_map(result, files)


def run_further_poses(task: FurtherPosesTask, context: StageContext, files: Path) -> None:
    """Store the camera's registration, and the poses of its lost frames in further maps."""
    from bodycap_batch.registration import localise_in_other_maps

    camera = load_capture(task.capture, task.keyframes, threads=context.threads).cameras[0]
    selection = load_keyframes(task.keyframes[camera.name].path)
    before = task.registration.path
    found, paths = localise_in_other_maps(
        load_registration(before), camera, load_map(task.map.path).maps, selection, task.options, context
    )
    replace_registration(found, before, files)
    write_dataclass(paths, files, OTHER_PATHS)
