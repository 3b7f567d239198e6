"""The task that solves the skeleton's motion."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from bodycap_batch.context import StageContext
from bodycap_batch.tasks.body import load_body
from bodycap_batch.tasks.loading import load_map
from bodycap_batch.tasks.registered import Registered
from bodycap_batch.tasks.stage import Json, Stage, write_summary

if TYPE_CHECKING:
    from bodycap_batch.body import MergeInputs


def _merge(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import MergeOptions
    from bodycap_batch.formats.bundle import write_bundle
    from bodycap_batch.merging import merge_trajectories

    inputs = _merge_inputs(arguments)
    result = merge_trajectories(inputs, MergeOptions.model_validate(options), context)
    write_bundle(result, files, "merge")
    write_summary(files, unused_cameras=dict(result.unused_cameras))


def _merge_inputs(arguments: Json) -> MergeInputs:
    from bodycap_batch.body import MergeInputs

    scene = load_map(arguments["map"])
    found = Registered.load(arguments["registrations"], scene.maps)
    skeleton, mounts = load_body(arguments)
    return MergeInputs(
        trajectories=found.trajectories,
        clocks=found.clocks,
        skeleton=skeleton,
        mounts=mounts,
        skeleton_is_measured=arguments["skeleton_file"] is not None,
        height_m=arguments["height_m"],
        activity=arguments["activity"],
        map_points={item.gauge: item.points for item in scene.maps},
        row_fraction=found.row_fraction,
    )


MERGE = Stage(
    function=_merge,
    libraries=("numpy", "scipy", "gtsam"),
    modules=("bodycap_batch.merging", "gtsam", "scipy.optimize", "scipy.spatial.transform"),
)
