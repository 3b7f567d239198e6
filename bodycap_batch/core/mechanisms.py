"""The mechanisms of the program that the bench can switch off, and the count of how often each one acted.

A mechanism is a part of the program whose gain must be measured. These switches are internal: no job file
and no command sets them. The environment variable `VARIABLE` names the mechanisms that are switched off. They
are part of the key of every stored result, and each stored result records which mechanisms acted.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum

from bodycap_batch.core.errors import JobError

VARIABLE = "BODYCAP_WITHOUT"
"""Environment variable with the names of the mechanisms that are switched off, separated by commas."""
KEY_OPTION = "without"
"""Name, in the options of an artefact's key, of the list of mechanisms that are switched off."""


class Mechanism(StrEnum):
    """A mechanism that can be switched off."""

    SECOND_DETECTION = "second_detection"
    FLIPPED_CAMERAS = "flipped_cameras"
    SKELETAL_SET = "skeletal_set"
    REPAIR = "repair"
    SECOND_REGISTRATION = "second_registration"
    DOMINANT_POINTS = "dominant_points"
    TRANSIENT_POINTS = "transient_points"
    WEARER_POINTS = "wearer_points"
    RECALIBRATION = "recalibration"
    READOUT_PROFILE = "readout_profile"
    REFINEMENT = "refinement"
    JOINT_VELOCITIES = "joint_velocities"
    EQUAL_CAMERAS = "equal_cameras"
    MISPLACED_KEYFRAMES = "misplaced_keyframes"
    CONTRADICTED_POSES = "contradicted_poses"
    POSE_OUTLIERS = "pose_outliers"
    EXTENSION = "extension"
    RECOVERY = "recovery"
    POINT_REFINEMENT = "point_refinement"
    START_DEPENDENCE = "start_dependence"
    PATH_SMOOTHING = "path_smoothing"
    STATIC_POINTS = "static_points"
    FIXED_REGIONS = "fixed_regions"
    MOVING_REGIONS = "moving_regions"
    LENS_FROM_TRACKS = "lens_from_tracks"
    NEIGHBOUR_MATCHES = "neighbour_matches"
    GAP_FILLING = "gap_filling"
    SENSOR_PATH = "sensor_path"
    FURTHER_MAPS = "further_maps"
    PURE_ROTATION = "pure_rotation"
    FREED_LENSES = "freed_lenses"
    CONTINUITY = "continuity"
    PAIR_ROTATIONS = "pair_rotations"
    MOUNT_SLIPS = "mount_slips"
    LYING = "lying"


@dataclass(slots=True)
class _TaskState:
    """The switches of this process's task, and what acted in it.

    Attributes:
        off: The mechanisms that are switched off; None in a process that runs no task.
        acted: How often each mechanism acted.
    """

    off: frozenset[Mechanism] | None = None
    acted: Counter[Mechanism] = field(default_factory=Counter)


_task = _TaskState()


def switched_off() -> frozenset[Mechanism]:
    """Return the mechanisms that are switched off in this process.

    Raises:
        JobError: The environment variable names an unknown mechanism.
    """
    if _task.off is not None:
        return _task.off
    return mechanisms_of(name for name in os.environ.get(VARIABLE, "").split(",") if name)


def mechanisms_of(names: Iterable[str]) -> frozenset[Mechanism]:
    """Return the mechanisms with the given names.

    Raises:
        JobError: There is no mechanism of that name.
    """
    known = {item.value: item for item in Mechanism}
    wanted = [name.strip() for name in names]
    if unknown := sorted(set(wanted) - known.keys()):
        raise JobError(
            f"{VARIABLE}: unknown mechanism {', '.join(unknown)}", hint=f"known: {', '.join(sorted(known))}"
        )
    return frozenset(known[name] for name in wanted)


def begin_task(options: Mapping[str, object]) -> None:
    """Use the switches of a task in this process, and count from 0 how often mechanisms act.

    Args:
        options: The options of the key of the task's artefact.
    """
    names = options.get(KEY_OPTION, ())
    assert isinstance(names, list | tuple)
    _task.off = mechanisms_of(str(name) for name in names)
    _task.acted.clear()


def is_on(mechanism: Mechanism) -> bool:
    """Return True if a mechanism is not switched off."""
    return mechanism not in switched_off()


def record_act(mechanism: Mechanism, times: int = 1) -> None:
    """Record that a mechanism acted: that it changed a result, `times` times."""
    if times > 0:
        _task.acted[mechanism] += times


def acted() -> dict[str, int]:
    """Return how often each mechanism acted since `begin_task`, by name. Only those that acted are named."""
    return {item.value: _task.acted[item] for item in sorted(_task.acted)}
