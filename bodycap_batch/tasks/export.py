"""The task that writes the results."""

from __future__ import annotations

from pathlib import Path

from bodycap_batch.core.context import StageContext
from bodycap_batch.tasks.loading import load_keyframes, load_map
from bodycap_batch.tasks.registered import Registered
from bodycap_batch.tasks.stage import RESULTS, Json, Stage


def _export(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import ExportOptions
    from bodycap_batch.export import ExportInputs, export_results
    from bodycap_batch.formats.dataclass_files import read_dataclass
    from bodycap_batch.model.merge_data import MergeResult

    scene = load_map(arguments["map"])
    found = Registered.load(arguments["registrations"], scene.maps)
    merged = arguments["merge"]
    inputs = ExportInputs(
        out_dir=files / RESULTS,
        maps=scene.maps,
        trajectories=found.trajectories,
        clocks=found.clocks,
        selections=tuple(load_keyframes(path) for path in arguments["keyframes"]),
        merge=None if merged is None else read_dataclass(MergeResult, Path(merged), "merge"),
        partial_reason=arguments["failure"],
        row_fraction=found.row_fraction,
        relative_poses=found.relative_poses(arguments["registrations"], arguments["segments"]),
        log=scene.log,
    )
    export_results(inputs, ExportOptions.model_validate(options), context)


EXPORT = Stage(
    function=_export,
    libraries=("numpy", "scipy", "open3d-cpu|open3d", "pygltflib", "usd-core", "ezc3d"),
    modules=(
        "bodycap_batch.export",
        "bodycap_batch.formats.open3d_preload",
        "pycolmap",
        "pygltflib",
        "scipy.spatial.transform",
    ),
)
