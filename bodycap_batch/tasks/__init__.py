"""The stages as tasks: load the inputs, call the stage, save what it returns. One module a stage."""

from __future__ import annotations

from bodycap_batch.tasks.body import reach_rows
from bodycap_batch.tasks.check import CHECK
from bodycap_batch.tasks.export import EXPORT
from bodycap_batch.tasks.keyframes import KEYFRAMES
from bodycap_batch.tasks.mapping import EXTEND, MAP, REFINE
from bodycap_batch.tasks.merge import MERGE
from bodycap_batch.tasks.registration import REGISTRATION
from bodycap_batch.tasks.stage import CAPTURE, RESULTS, SUMMARY, Stage, read_summary
from bodycap_batch.tasks.synth import SYNTH

__all__ = ["CAPTURE", "RESULTS", "STAGES", "SUMMARY", "Stage", "reach_rows", "read_summary"]

STAGES = {
    "synth": SYNTH,
    "check": CHECK,
    "keyframes": KEYFRAMES,
    "map": MAP,
    "extend": EXTEND,
    "refine": REFINE,
    "registration": REGISTRATION,
    "merge": MERGE,
    "export": EXPORT,
}
