"""Names of a job's stages and their order."""

from __future__ import annotations

from typing import Literal, get_args

StageName = Literal["check", "keyframes", "map", "registration", "merge", "export", "report", "preview"]
STAGE_ORDER: tuple[StageName, ...] = get_args(StageName)
"""The stages of a job in the order in which they run."""
_DURING_REGISTRATION = frozenset({"extend", "refine", "rig", "recover"})
"""Further stages that may run between registration and merge: the map is extended and refined, the cameras of
a rig are solved together, and lost frames are recovered."""


def stages_from(stage: StageName) -> frozenset[str]:
    """Return a stage of `STAGE_ORDER` and all stages after it."""
    later = set[str](STAGE_ORDER[STAGE_ORDER.index(stage) :])
    return frozenset(later | (_DURING_REGISTRATION if "registration" in later else set()))
