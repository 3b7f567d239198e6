"""The task that decides which clock each camera has."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.formats.dataclass_files import write_dataclass
from bodycap_batch.tasks.inputs import ArtefactRef, CaptureRef, StatedClock
from bodycap_batch.tasks.loading import CLOCKS_NAME, load_map, load_registration
from bodycap_batch.tasks.sound import load_sound
from bodycap_batch.tasks.stage import write_summary


@dataclass(frozen=True, slots=True, kw_only=True)
class ClocksTask:
    """Decide which clock each camera has.

    Attributes:
        capture: The videos of all cameras.
        stated: What is stated about the clock of each camera, by camera name.
        common: Whether the job says that all clocks agree (`capture.clocks`).
        rig: Whether cameras on one segment share a trigger (`capture.rig`).
        sound: What the sound says; None if there is only one camera.
        map: The map.
        registrations: The registration of each camera, by camera name.
        reach: Rows of names of two cameras, and smallest and largest distance (metres) that the body permits
            between them, for a body of the skeleton's nominal size.
    """

    capture: CaptureRef
    stated: Mapping[str, StatedClock]
    common: str
    rig: str
    sound: ArtefactRef | None
    map: ArtefactRef
    registrations: Mapping[str, ArtefactRef]
    reach: tuple[tuple[str, str, float, float], ...]


def run_clocks(task: ClocksTask, _: StageContext, files: Path) -> None:
    """Decide which clock each camera has, and store the clocks."""
    from bodycap_batch.clocks import (
        add_motion,
        clock_notes,
        clocks_from_paths,
        combine_evidence,
        decide_clocks,
        stated_offsets,
    )
    from bodycap_batch.mapping.validation.camera_distance_check import check_distances

    capture = task.capture.config
    evidence = load_sound(None if task.sound is None else task.sound.path)
    paths = [load_registration(artefact.path).trajectory for artefact in task.registrations.values()]
    estimates = combine_evidence(capture, evidence)
    if len(paths) > 1:
        roles = {name: stated.role or "" for name, stated in task.stated.items()}
        motion = clocks_from_paths(paths, roles, estimates.reference)
        stated_s = stated_offsets(capture, estimates.reference)
        estimates = add_motion(estimates, motion, evidence, stated_s)
    clocks = decide_clocks(capture, estimates)
    write_dataclass(clocks, files, CLOCKS_NAME)
    reach = {(first, second): (least_m, most_m) for first, second, least_m, most_m in task.reach}
    distances = None
    if reach:
        times_ns = {path.camera: path.times_ns for path in paths}
        known = {name: clock for name, clock in clocks.cameras.items() if clock.is_known}
        common_ns = {name: clock.common_ns(times_ns[name]) for name, clock in known.items()}
        distances = check_distances(load_map(task.map.path).maps[0], common_ns, reach).to_log()
    unknown = [name for name, clock in clocks.cameras.items() if not clock.is_known]
    write_summary(files, notes=clock_notes(clocks), distances=distances, unknown=unknown)
