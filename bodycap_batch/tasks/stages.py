"""The table of all stages: the task of each stage, and what the runner needs to know to run it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from bodycap_batch.core.context import StageContext
from bodycap_batch.store.code_version import Program
from bodycap_batch.tasks.check import CheckTask, run_check
from bodycap_batch.tasks.clocks import ClocksTask, run_clocks
from bodycap_batch.tasks.export import ExportTask, run_export
from bodycap_batch.tasks.fill import FillTask, run_fill
from bodycap_batch.tasks.further import FurtherMapsTask, FurtherPosesTask, run_further_maps, run_further_poses
from bodycap_batch.tasks.inertial import InertialTask, run_inertial
from bodycap_batch.tasks.keyframes import KeyframesTask, run_keyframes
from bodycap_batch.tasks.links import LinksTask, run_links
from bodycap_batch.tasks.mapping import ExtendTask, MapTask, RefineTask, run_extend, run_map, run_refine
from bodycap_batch.tasks.merge import MergeTask, run_merge
from bodycap_batch.tasks.order import CHECK_MODULES, STAGE_ORDER, VIDEO_MODULES, StageName
from bodycap_batch.tasks.places import PlacesTask, run_places
from bodycap_batch.tasks.preview import PreviewTask, run_preview
from bodycap_batch.tasks.recover import RecoverTask, run_recover
from bodycap_batch.tasks.registration import RegistrationTask, run_registration
from bodycap_batch.tasks.report import ReportTask, run_report
from bodycap_batch.tasks.rotations import RotationsTask, run_rotations
from bodycap_batch.tasks.sound import SoundTask, run_sound
from bodycap_batch.tasks.synth import SynthTask, run_synth
from bodycap_batch.tasks.typed_json import from_json
from bodycap_batch.tasks.undistort import UndistortTask, run_undistort

_VIDEO = ("numpy", "av", "opencv-python-headless|opencv-python")
"""Python distributions that a stage needs to decode and process images."""
_MAP_MODULES = (*VIDEO_MODULES, "pycolmap", "bodycap_batch.mapping")
_MAP_MEMORY_MB = 1500
"""Memory to reserve (MB) for a task that builds, extends or refines a map.
Evidence: docs/decisions/pipeline.md."""
_RECOVERY_MEMORY_MB = 900
"""Memory to reserve (MB) for a recovery task. Recovery holds a limited number of keyframes and frames in
memory, about half a megabyte for each image."""
_TaskT = TypeVar("_TaskT")


@dataclass(frozen=True, slots=True)
class Stage(Generic[_TaskT]):
    """A stage, and what the runner needs to know to run its tasks.

    Attributes:
        name: Stage name.
        task: The dataclass that describes one task of the stage.
        function: Function that runs a task in the child process. Its arguments are the task, the context and
            the folder that becomes the artefact. The stage's algorithm is the code of the function's module
            and of all modules of this package that this module imports. A digest of this code is part of the
            artefact's key.
        step: The stage of `STAGE_ORDER` that this stage is, or is a part of; None if it is part of no job.
        libraries: Python distributions that the result depends on. An entry ``a|b`` means that either a or b
            is installed.
        modules: Modules that take long to load. A child process may load them before it gets a task.
        memory_mb: Memory (MB) to reserve for one task. The reservation keeps two large tasks from running at
            the same time on a small machine.
    """

    name: str
    task: type[_TaskT]
    function: Callable[[_TaskT, StageContext, Path], None]
    step: StageName | None
    libraries: tuple[str, ...]
    modules: tuple[str, ...] = ()
    memory_mb: int = 500

    @property
    def program(self) -> Program:
        """The code that computes the results of the stage."""
        return Program(self.function.__module__.partition(".")[2], self.libraries)

    def run(self, arguments: Mapping[str, Any], context: StageContext, files: Path) -> None:
        """Run a task.

        Args:
            arguments: The task as JSON values, from `to_json`.
            context: The stage's context.
            files: The folder that becomes the artefact.
        """
        self.function(from_json(self.task, arguments), context, files)


_TABLE: tuple[Stage[Any], ...] = (
    Stage("synth", SynthTask, run_synth, None, ("numpy", "av", "open3d-cpu|open3d")),
    Stage("check", CheckTask, run_check, "check", _VIDEO, CHECK_MODULES),
    Stage("sound", SoundTask, run_sound, "keyframes", _VIDEO, VIDEO_MODULES),
    Stage(
        "keyframes", KeyframesTask, run_keyframes, "keyframes", _VIDEO,
        (*VIDEO_MODULES, "bodycap_batch.keyframes", "pycolmap"),
    ),
    Stage("map", MapTask, run_map, "map", (*_VIDEO, "pycolmap"), _MAP_MODULES, _MAP_MEMORY_MB),
    Stage(
        "registration", RegistrationTask, run_registration, "registration", (*_VIDEO, "pycolmap"),
        (*VIDEO_MODULES, "pycolmap", "bodycap_batch.registration"),
    ),
    Stage(
        "extend", ExtendTask, run_extend, "registration", (*_VIDEO, "pycolmap"), _MAP_MODULES, _MAP_MEMORY_MB
    ),
    Stage(
        "refine", RefineTask, run_refine, "registration", (*_VIDEO, "pycolmap"), _MAP_MODULES, _MAP_MEMORY_MB
    ),
    Stage(
        "recover", RecoverTask, run_recover, "registration", (*_VIDEO, "pycolmap"),
        (*VIDEO_MODULES, "pycolmap"), _RECOVERY_MEMORY_MB,
    ),
    Stage(
        "places", PlacesTask, run_places, "registration", ("numpy", "scipy"), ("bodycap_batch.camera_places",)
    ),
    Stage(
        "clocks", ClocksTask, run_clocks, "registration", ("numpy", "scipy"),
        ("bodycap_batch.clocks", "bodycap_batch.mapping.validation.camera_distance_check"),
    ),
    Stage(
        "inertial", InertialTask, run_inertial, "registration", (*_VIDEO, "scipy"),
        (*VIDEO_MODULES, "bodycap_batch.inertial", "scipy.optimize", "scipy.interpolate"),
    ),
    Stage(
        "further_maps", FurtherMapsTask, run_further_maps, "registration", (*_VIDEO, "pycolmap"),
        _MAP_MODULES, _MAP_MEMORY_MB,
    ),
    Stage(
        "further_poses", FurtherPosesTask, run_further_poses, "registration", (*_VIDEO, "pycolmap"),
        (*VIDEO_MODULES, "pycolmap", "bodycap_batch.registration"),
    ),
    Stage(
        "links", LinksTask, run_links, "registration",
        ("numpy", "scipy", "opencv-python-headless|opencv-python", "pycolmap"),
        ("bodycap_batch.evaluate.track_check",),
    ),
    Stage(
        "rotations", RotationsTask, run_rotations, "registration", (*_VIDEO, "pycolmap", "scipy"),
        (*VIDEO_MODULES, "pycolmap"),
    ),
    Stage(
        "merge", MergeTask, run_merge, "merge", ("scipy", "gtsam", *_VIDEO),
        ("bodycap_batch.merging.stage", "gtsam", "scipy.optimize", "scipy.spatial.transform"),
    ),
    Stage(
        "fill", FillTask, run_fill, "fill", ("numpy", "scipy"),
        ("bodycap_batch.fill", "scipy.signal", "scipy.spatial.transform"),
    ),
    Stage(
        "export", ExportTask, run_export, "export",
        ("numpy", "scipy", "open3d-cpu|open3d", "pygltflib", "usd-core", "ezc3d"),
        (
            "bodycap_batch.export", "bodycap_batch.formats.open3d_preload", "pycolmap", "pygltflib",
            "scipy.spatial.transform",
        ),
    ),
    Stage(
        "report", ReportTask, run_report, "report", (*_VIDEO, "jinja2", "k3d", "pycolmap", "scipy"),
        (*VIDEO_MODULES, "bodycap_batch.report", "jinja2", "pycolmap", "scipy.spatial.transform"),
    ),
    Stage(
        "preview", PreviewTask, run_preview, "preview", (*_VIDEO, "scipy", "pycolmap"),
        (*VIDEO_MODULES, "bodycap_batch.preview", "pycolmap", "scipy.spatial.transform"),
    ),
    Stage(
        "undistort", UndistortTask, run_undistort, None, (*_VIDEO, "pycolmap"),
        (*VIDEO_MODULES, "bodycap_batch.preview", "pycolmap"),
    ),
)  # fmt: skip
STAGES: Mapping[str, Stage[Any]] = {stage.name: stage for stage in _TABLE}
"""Each stage by its name, in the order of a job."""
_OF_TASK = {stage.task: stage for stage in _TABLE}


def stage_of(task: object) -> Stage[Any]:
    """Return the stage of a typed task."""
    return _OF_TASK[type(task)]


def stages_from(first: StageName) -> frozenset[str]:
    """Return the names of a stage of `STAGE_ORDER`, of the later stages, and of all their parts."""
    later = STAGE_ORDER[STAGE_ORDER.index(first) :]
    return frozenset(stage.name for stage in _TABLE if stage.step in later)
