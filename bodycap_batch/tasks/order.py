"""The names of a job's stages in their order, and what the first one loads: what a command needs at once."""

from __future__ import annotations

from typing import Literal, get_args

StageName = Literal[
    "check", "keyframes", "map", "registration", "merge", "fill", "export", "report", "preview"
]
STAGE_ORDER: tuple[StageName, ...] = get_args(StageName)
"""The stages of a job that a user can name, in the order in which they run. Further stages run as a part of
one of them (`bodycap_batch.tasks.stages`)."""
VIDEO_MODULES = ("bodycap_batch.capture", "bodycap_batch.config.models", "cv2", "av")
"""Modules that a stage loads to decode and process images."""
CHECK_MODULES = (*VIDEO_MODULES, "bodycap_batch.check", "bodycap_batch.telemetry.gopro")
"""Modules that the first stage loads. A child loads them while the command still imports the pipeline."""
