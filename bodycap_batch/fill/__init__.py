"""The fill stage: give unmeasured legs, pelvis, neck and head a plausible motion, and mark it as such."""

from bodycap_batch.fill.stage import fill_motion

__all__ = ["fill_motion"]
