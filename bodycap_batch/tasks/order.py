"""The names of a job's stages, in the order of the stages."""

from __future__ import annotations

from typing import Literal, get_args

StageName = Literal[
    "check", "keyframes", "map", "registration", "merge", "fill", "export", "report", "preview"
]
STAGE_ORDER: tuple[StageName, ...] = get_args(StageName)
"""The stages of a job that a user can name, in the order in which they run. Further stages run as a part of
one of them (`bodycap_batch.tasks.stages`)."""
