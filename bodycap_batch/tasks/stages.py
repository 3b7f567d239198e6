"""The table of all stages by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bodycap_batch.tasks.check import CHECK
from bodycap_batch.tasks.clocks import CLOCKS
from bodycap_batch.tasks.export import EXPORT
from bodycap_batch.tasks.fill import FILL
from bodycap_batch.tasks.further import FURTHER_MAPS, FURTHER_POSES
from bodycap_batch.tasks.inertial import INERTIAL
from bodycap_batch.tasks.keyframes import KEYFRAMES
from bodycap_batch.tasks.links import LINKS
from bodycap_batch.tasks.mapping import EXTEND, MAP, REFINE
from bodycap_batch.tasks.merge import MERGE
from bodycap_batch.tasks.places import PLACES
from bodycap_batch.tasks.preview import PREVIEW
from bodycap_batch.tasks.recover import RECOVER
from bodycap_batch.tasks.registration import REGISTRATION
from bodycap_batch.tasks.report import REPORT
from bodycap_batch.tasks.rotations import ROTATIONS
from bodycap_batch.tasks.sound import SOUND
from bodycap_batch.tasks.stage import Stage
from bodycap_batch.tasks.synth import SYNTH
from bodycap_batch.tasks.undistort import UNDISTORT

STAGES: Mapping[str, Stage[Any]] = {
    stage.name: stage
    for stage in (
        SYNTH,
        CHECK,
        KEYFRAMES,
        MAP,
        EXTEND,
        REFINE,
        REGISTRATION,
        RECOVER,
        SOUND,
        CLOCKS,
        PLACES,
        INERTIAL,
        FURTHER_MAPS,
        FURTHER_POSES,
        LINKS,
        ROTATIONS,
        MERGE,
        FILL,
        EXPORT,
        REPORT,
        PREVIEW,
        UNDISTORT,
    )
}
