"""The stages as tasks: load the inputs, call the stage, save what it returns."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bodycap_batch.context import StageContext

if TYPE_CHECKING:
    from bodycap_batch.arrays import FloatArray
    from bodycap_batch.body import CameraClock, MergeInputs
    from bodycap_batch.camera import Camera
    from bodycap_batch.capture import Capture
    from bodycap_batch.scene import Map, MapResult, Registration, Trajectory
    from bodycap_batch.skeleton import Mount, SkeletonModel

SUMMARY = "summary.json"
CAPTURE = "capture"
"""Folder of a synth artefact that holds the videos and the truth."""
RESULTS = "results"
"""Folder of an export artefact that holds what goes to the user."""
Json = Mapping[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stage:
    """A stage as the runner sees it.

    Attributes:
        function: Called in the child with options, arguments, context and the artefact's folder.
        rooms: The module that holds the algorithm, and what the task itself computes or writes with.
        libraries: Distributions the result depends on (``a|b``: either).
        modules: What takes long to load; a child may load it ahead.
    """

    function: Callable[[Json, Json, StageContext, Path], None]
    rooms: tuple[str, ...]
    libraries: tuple[str, ...]
    modules: tuple[str, ...] = ()


def functions() -> dict[str, Callable[[Json, Json, StageContext, Path], None]]:
    """What to call for each stage."""
    return {name: stage.function for name, stage in STAGES.items()}


def read_summary(artefact: Path) -> dict[str, Any]:
    """The few figures of an artefact that decide what is done next."""
    return dict(json.loads((artefact / SUMMARY).read_text(encoding="utf-8")))


def _synth(options: Json, _: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.synthetic import SynthOptions, synthesise

    synthesise(SynthOptions.model_validate(options), files / CAPTURE, context)


def _check(_: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.check import require_ready
    from bodycap_batch.config.models import Job

    context.check_cancelled()
    report = require_ready(Job.model_validate(arguments["job"]))
    notes = [f"{camera.name}: {note}" for camera in report.cameras for note in camera.notes]
    _write_summary(files, notes=[*notes, *report.notes])


def _keyframes(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import KeyframeOptions
    from bodycap_batch.formats.bundle import write_bundle
    from bodycap_batch.keyframes import select_keyframes

    camera = _capture(arguments).cameras[0]
    selection = select_keyframes(camera, KeyframeOptions.model_validate(options), context)
    write_bundle(selection, files, "keyframes")
    _write_summary(files, frames=selection.frame_count, keyframes=len(selection.frames))


def _map(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import MapOptions
    from bodycap_batch.formats.bundle import read_bundle
    from bodycap_batch.mapping import build_map
    from bodycap_batch.scene import KeyframeSelection

    selections = [read_bundle(KeyframeSelection, Path(path), "keyframes") for path in arguments["selections"]]
    reach = {(first, second): (low, high) for first, second, low, high in arguments.get("reach", ())}
    options_ = MapOptions.model_validate(options)
    result = build_map(_capture(arguments), selections, options_, context, reach or None)
    _save_map(result, files)


def _extend(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    import numpy as np

    from bodycap_batch.config import MapOptions
    from bodycap_batch.mapping import extend_map

    extra = {name: np.asarray(frames, dtype=np.int64) for name, frames in arguments["extra"].items()}
    previous = _load_map(arguments["previous"])
    options_ = MapOptions.model_validate(options)
    _save_map(extend_map(_capture(arguments), previous, extra, options_, context), files)


def _refine(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import MapOptions
    from bodycap_batch.mapping import refine_map

    paths = [_load_registration(path).trajectory for path in arguments["registrations"]]
    previous = _load_map(arguments["previous"])
    options_ = MapOptions.model_validate(options)
    _save_map(refine_map(_capture(arguments), previous, paths, options_, context), files)


def _registration(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.body import CameraClock
    from bodycap_batch.config import RegistrationOptions
    from bodycap_batch.formats.bundle import read_bundle, write_bundle
    from bodycap_batch.registration import register_frames
    from bodycap_batch.rolling_shutter import looks_rolling
    from bodycap_batch.scene import KeyframeSelection

    camera = _capture(arguments).cameras[0]
    selection = read_bundle(KeyframeSelection, Path(arguments["selection"]), "keyframes")
    previous = _load_registration(arguments["previous"]) if arguments.get("previous") else None
    options_ = RegistrationOptions.model_validate(options)
    maps = _load_map(arguments["map"]).maps
    found = register_frames(camera, maps, selection, options_, context, previous)
    known = camera.rolling_shutter_known
    write_bundle(found, files, "registration")
    clock = CameraClock(
        nominal_fps=camera.nominal_fps,
        offset_s=camera.offset_s,
        rolling_shutter_s=camera.rolling_shutter_s,
    )
    write_bundle(clock, files, "clock")
    write_bundle(camera.camera, files, "camera")
    _write_summary(
        files,
        frames=len(found.trajectory.status),
        localised=int(found.trajectory.localised.sum()),
        wanted=[int(frame) for frame in found.wanted_keyframes],
        rolling=bool(camera.rolling_shutter_s) if known else looks_rolling(found, maps),
    )


def _merge(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.config import MergeOptions
    from bodycap_batch.formats.bundle import write_bundle
    from bodycap_batch.merging import merge_trajectories

    inputs = _merge_inputs(arguments)
    result = merge_trajectories(inputs, MergeOptions.model_validate(options), context)
    write_bundle(result, files, "merge")
    _write_summary(files, unused_cameras=dict(result.unused_cameras))


def _export(options: Json, arguments: Json, context: StageContext, files: Path) -> None:
    from bodycap_batch.body import MergeResult
    from bodycap_batch.config import ExportOptions
    from bodycap_batch.export import ExportInputs, export_results
    from bodycap_batch.formats.bundle import read_bundle
    from bodycap_batch.scene import KeyframeSelection

    scene = _load_map(arguments["map"])
    found = _Registered.load(arguments["registrations"], scene.maps)
    merged = arguments["merge"]
    inputs = ExportInputs(
        out_dir=files / RESULTS,
        maps=scene.maps,
        trajectories=found.trajectories,
        clocks=found.clocks,
        selections=tuple(
            read_bundle(KeyframeSelection, Path(path), "keyframes") for path in arguments["keyframes"]
        ),
        merge=None if merged is None else read_bundle(MergeResult, Path(merged), "merge"),
        partial_reason=arguments["failure"],
        row_fraction=found.row_fraction,
        log=scene.log,
    )
    export_results(inputs, ExportOptions.model_validate(options), context)


def _capture(arguments: Json) -> Capture:
    from bodycap_batch.capture import open_capture
    from bodycap_batch.config.models import CaptureConfig

    return open_capture(CaptureConfig.model_validate(arguments["capture"]))


def _save_map(result: MapResult, files: Path) -> None:
    """Keep a map together with the workspace that is needed to extend it."""
    from bodycap_batch.formats.bundle import write_bundle
    from bodycap_batch.mapping.lens import misfit_note

    workspace = files / "workspace"
    os.rename(result.workspace, workspace)
    write_bundle(dataclasses.replace(result, workspace=workspace), files, "map")
    largest = result.maps[0]
    wrong: Mapping[str, float] = result.log.get("misfitting_lenses", {})
    _write_summary(
        files,
        keyframes=len(largest.keyframe_camera),
        points=len(largest.points),
        notes=[misfit_note(camera, factor) for camera, factor in sorted(wrong.items())],
    )


def _load_map(path: str) -> MapResult:
    from bodycap_batch.formats.bundle import read_bundle
    from bodycap_batch.scene import MapResult

    return read_bundle(MapResult, Path(path), "map")


def _load_registration(path: str) -> Registration:
    from bodycap_batch.formats.bundle import read_bundle
    from bodycap_batch.scene import Registration

    return read_bundle(Registration, Path(path), "registration")


def _merge_inputs(arguments: Json) -> MergeInputs:
    from bodycap_batch.body import MergeInputs

    scene = _load_map(arguments["map"])
    found = _Registered.load(arguments["registrations"], scene.maps)
    skeleton = _skeleton(arguments)
    return MergeInputs(
        trajectories=found.trajectories,
        clocks=found.clocks,
        skeleton=skeleton,
        mounts=tuple(_mount(block, skeleton) for block in arguments["mounts"]),
        skeleton_is_measured=arguments["skeleton_file"] is not None,
        height_m=arguments["height_m"],
        activity=arguments["activity"],
        map_points={item.gauge: item.points for item in scene.maps},
        row_fraction=found.row_fraction,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class _Registered:
    """What registration left of all cameras."""

    trajectories: tuple[Trajectory, ...]
    clocks: Mapping[str, CameraClock]
    row_fraction: Mapping[str, FloatArray]

    @staticmethod
    def load(paths: Sequence[str], maps: Sequence[Map]) -> _Registered:
        """Read one artefact per camera; rows matter where a rolling shutter is still in the poses."""
        from bodycap_batch.body import CameraClock
        from bodycap_batch.camera import Camera
        from bodycap_batch.formats.bundle import read_bundle

        found = {path: _load_registration(path) for path in paths}
        corrected = {name for each in maps for name in each.readout_s}
        clocks = {
            item.trajectory.camera: read_bundle(CameraClock, Path(path), "clock")
            for path, item in found.items()
        }
        return _Registered(
            trajectories=tuple(item.trajectory for item in found.values()),
            clocks=clocks,
            row_fraction={
                item.trajectory.camera: _row_fraction(item, read_bundle(Camera, Path(path), "camera"))
                for path, item in found.items()
                if clocks[item.trajectory.camera].rolling_shutter_s
                and item.trajectory.camera not in corrected
            },
        )


def _skeleton(arguments: Json) -> SkeletonModel:
    if arguments["skeleton_file"] is not None:
        from bodycap_batch.formats.bvh import read_bvh

        return read_bvh(Path(arguments["skeleton_file"]))[0]
    from bodycap_batch.skeleton_presets import load_skeleton

    return load_skeleton(arguments["skeleton"], arguments["height_m"])


def reach_rows(body: Json) -> list[tuple[str, str, float, float]]:
    """How near and how far a job's cameras can be to each other: rows (camera, camera, least, most), metres.

    Args:
        body: Skeleton and mounts, as the merge task takes them.
    """
    from bodycap_batch.skeleton_presets import camera_reach

    # A map has no scale, so only proportions matter to it: a stature stated later makes no other map.
    skeleton = _skeleton({**body, "height_m": None})
    return camera_reach(skeleton, [_mount(block, skeleton) for block in body["mounts"]])


def _mount(block: Json, skeleton: SkeletonModel) -> Mount:
    """The prior of one camera's mount: nominal for its place, or what the job measured."""
    import numpy as np

    from bodycap_batch.skeleton import Mount
    from bodycap_batch.skeleton_presets import STATED_SIGMA_M, STATED_SIGMA_RAD, nominal_mount

    nominal = nominal_mount(block["place"], block["role"], skeleton)
    pose, sigma_deg, sigma_m = (block[name] for name in ("joint_from_cam", "sigma_deg", "sigma_m"))
    usual = (nominal.sigma_rad, nominal.sigma_m) if pose is None else (STATED_SIGMA_RAD, STATED_SIGMA_M)
    return Mount(
        camera=block["camera"],
        role=block["role"],
        joint_from_cam=nominal.joint_from_cam if pose is None else np.array(pose, dtype=np.float64),
        sigma_rad=usual[0] if sigma_deg is None else float(np.radians(sigma_deg)),
        sigma_m=usual[1] if sigma_m is None else sigma_m,
    )


def _row_fraction(found: Registration, camera: Camera) -> FloatArray:
    """(N,) mean row of the observations behind each pose over the image height; NaN without a pose."""
    import numpy as np

    count = len(found.trajectory.status)
    seen = np.bincount(found.obs_frame, minlength=count)
    rows = np.bincount(found.obs_frame, weights=found.obs_px[:, 1].astype(np.float64), minlength=count)
    mean = np.full(count, 0.5)
    np.divide(rows, seen * camera.height_px, out=mean, where=seen > 0)
    return np.where(found.trajectory.localised, mean, np.nan)


def _write_summary(files: Path, **values: Any) -> None:
    (files / SUMMARY).write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


_VISION = ("numpy", "av", "opencv-python-headless|opencv-python")
_SEEING = ("bodycap_batch.capture", "bodycap_batch.config.models", "cv2", "av")
_KEPT = ("formats.bundle", "scene")
STAGES = {
    "synth": Stage(function=_synth, rooms=("synthetic",), libraries=("numpy", "av", "open3d-cpu|open3d")),
    "check": Stage(function=_check, rooms=("check",), libraries=_VISION, modules=_SEEING),
    "keyframes": Stage(function=_keyframes, rooms=("keyframes", *_KEPT), libraries=_VISION, modules=_SEEING),
    "map": Stage(
        function=_map,
        rooms=("mapping", *_KEPT),
        libraries=(*_VISION, "pycolmap"),
        modules=(*_SEEING, "pycolmap"),
    ),
    "extend": Stage(
        function=_extend,
        rooms=("mapping", *_KEPT),
        libraries=(*_VISION, "pycolmap"),
        modules=(*_SEEING, "pycolmap"),
    ),
    "refine": Stage(
        function=_refine,
        rooms=("mapping", *_KEPT),
        libraries=(*_VISION, "pycolmap"),
        modules=(*_SEEING, "pycolmap"),
    ),
    "registration": Stage(
        function=_registration,
        rooms=("registration", "body", *_KEPT),
        libraries=(*_VISION, "pycolmap"),
        modules=(*_SEEING, "pycolmap"),
    ),
    "merge": Stage(
        function=_merge,
        rooms=("merging", "skeleton_presets", "formats.bvh", *_KEPT),
        libraries=("numpy", "scipy", "gtsam"),
        modules=("bodycap_batch.merging", "gtsam", "scipy.optimize", "scipy.spatial.transform"),
    ),
    "export": Stage(
        function=_export,
        rooms=("export", *_KEPT),
        libraries=("numpy", "scipy", "open3d-cpu|open3d"),
        modules=("bodycap_batch.export", "open3d", "scipy.spatial.transform"),
    ),
}
