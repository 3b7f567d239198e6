"""The result of the fill stage. Export, report and preview use it too."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.model.skeleton import Motion

FillMode = Literal["plausible", "rest", "none"]
"""How joints that no camera measured are posed. ``plausible``: by a motion that fits the measured joints.
``rest``: by the rest pose. ``none``: they are left out of the files."""

SIDES = ("Left", "Right")
"""The sides of the body, in the order of all arrays that have one entry for each side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Footsteps:
    """The periods in which the filled feet stand, N in all, sorted by start.

    They are assumptions that fit the motion of the trunk and the hands. They are not measurements.

    Attributes:
        side: (N,) index of the foot in `SIDES`.
        start_tick: (N,) first tick at which the foot stands.
        end_tick: (N,) tick after the last tick at which the foot stands.
        ankle_in_world_m: (N,3) centre of the ankle in the world while the foot is flat, metres.
        heading_rad: (N,) direction of the foot: the rotation about z, 0 for a foot that points to −y.
        is_sure: (N,) False if the measured motion does not determine the side or the time of the step.
    """

    side: IntArray
    start_tick: IntArray
    end_tick: IntArray
    ankle_in_world_m: FloatArray
    heading_rad: FloatArray
    is_sure: BoolArray

    def __post_init__(self) -> None:
        count = len(self.side)
        for name in ("side", "start_tick", "end_tick"):
            set_array(self, name, (count,), np.int64)
        set_array(self, "ankle_in_world_m", (count, 3))
        set_array(self, "heading_rad", (count,))
        set_array(self, "is_sure", (count,), np.bool_)

    def keep(self, mask: BoolArray) -> Footsteps:
        """Return the periods for which `mask` (N,) is True."""
        return Footsteps(**{item.name: getattr(self, item.name)[mask] for item in fields(self)})


@dataclass(frozen=True, slots=True, kw_only=True)
class FillReport:
    """What the fill stage did.

    Attributes:
        mode: How unmeasured joints are posed.
        filled: (J,) True for a joint whose pose the stage computed.
        standing: (T,2) True if the left or right foot stands at the tick; False for all ticks if the legs are
            not filled.
        is_sure: (T,) False if the measured motion does not determine what the feet do at the tick.
        footsteps: The periods in which a filled foot stands.
        floor_m: Height (metres) of the floor in the world that the filled feet stand on.
        floor_sigma_m: Standard deviation of this height, metres.
        floor_source: ``measured``, or ``legs`` if the height was estimated from straight legs.
    """

    mode: FillMode
    filled: BoolArray
    standing: BoolArray
    is_sure: BoolArray
    footsteps: Footsteps
    floor_m: float
    floor_sigma_m: float
    floor_source: str

    def __post_init__(self) -> None:
        ticks = len(self.is_sure)
        set_array(self, "filled", (len(self.filled),), np.bool_)
        set_array(self, "standing", (ticks, len(SIDES)), np.bool_)
        set_array(self, "is_sure", (ticks,), np.bool_)


@dataclass(frozen=True, slots=True, kw_only=True)
class FillResult:
    """The result of the fill stage.

    Attributes:
        motion: The motion with the filled joints. The measured joints have the same poses in the world as in
            the motion from merging.
        report: What the stage did.
    """

    motion: Motion
    report: FillReport
