"""The names of a job's stages, in the order of the stages."""

from __future__ import annotations

from typing import Literal, get_args

StageName = Literal[
    "check", "keyframes", "map", "registration", "merge", "fill", "export", "report", "preview"
]
STAGE_ORDER: tuple[StageName, ...] = get_args(StageName)
"""The stages of a job in the order in which they run."""
BESIDE_KEYFRAMES = frozenset({"sound"})
"""Further stages that run at the same time as the keyframes."""
_DURING_REGISTRATION = frozenset(
    {
        "extend",
        "refine",
        "recover",
        "clocks",
        "places",
        "inertial",
        "further_maps",
        "further_poses",
        "links",
        "rotations",
    }
)
"""Further stages that may run up to the merge. They extend and refine the map, recover lost frames, determine
the clocks, find the places of cameras from the motion, use the inertial sensors, map what is still
lost, compare the paths with the tracks, and measure rotations without positions."""


def stages_from(stage: StageName) -> frozenset[str]:
    """Return the name of a given stage of `STAGE_ORDER`, and the names of all stages that run after it."""
    later = set[str](STAGE_ORDER[STAGE_ORDER.index(stage) :])
    if "keyframes" in later:
        later |= BESIDE_KEYFRAMES
    if "registration" in later:
        later |= _DURING_REGISTRATION
    return frozenset(later)
