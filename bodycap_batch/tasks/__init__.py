"""The stages as tasks: load the inputs, call the stage, save what it returns. One module a stage."""

from __future__ import annotations

from typing import Literal, get_args

from bodycap_batch.tasks.body import reach_rows
from bodycap_batch.tasks.check import CHECK
from bodycap_batch.tasks.export import EXPORT
from bodycap_batch.tasks.keyframes import KEYFRAMES
from bodycap_batch.tasks.mapping import EXTEND, MAP, REFINE
from bodycap_batch.tasks.merge import MERGE
from bodycap_batch.tasks.preview import PREVIEW
from bodycap_batch.tasks.recover import RECOVER
from bodycap_batch.tasks.registration import REGISTRATION
from bodycap_batch.tasks.report import REPORT
from bodycap_batch.tasks.rig import RIG
from bodycap_batch.tasks.stage import CAPTURE, RESULTS, SUMMARY, Stage, read_summary
from bodycap_batch.tasks.synth import SYNTH

__all__ = [
    "CAPTURE",
    "ORDER",
    "RESULTS",
    "STAGES",
    "SUMMARY",
    "Stage",
    "StageName",
    "reach_rows",
    "read_summary",
    "stages_from",
]

STAGES = {
    "synth": SYNTH,
    "check": CHECK,
    "keyframes": KEYFRAMES,
    "map": MAP,
    "extend": EXTEND,
    "refine": REFINE,
    "registration": REGISTRATION,
    "rig": RIG,
    "recover": RECOVER,
    "merge": MERGE,
    "export": EXPORT,
    "report": REPORT,
    "preview": PREVIEW,
}

StageName = Literal["check", "keyframes", "map", "registration", "merge", "export", "report", "preview"]
ORDER: tuple[StageName, ...] = get_args(StageName)
"""A job's stages one after another. While frames are registered the map may be extended and refined, and the
cameras of a rig be solved together, and lost frames be looked for once more."""
_DURING_REGISTRATION = {"extend", "refine", "rig", "recover"}


def stages_from(stage: StageName) -> frozenset[str]:
    """A stage of `ORDER` and all that come after it."""
    later = set[str](ORDER[ORDER.index(stage) :])
    return frozenset(later | (_DURING_REGISTRATION if "registration" in later else set()))
