"""Run the checks of a job in order: cameras, files, clocks, named frames, skeleton, formats, disk."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from bodycap_batch.capture import CaptureCamera, open_camera
from bodycap_batch.capture.damage import damage_notes, find_damage_and_copies
from bodycap_batch.check.camera_settings import calibration_notes, setting_notes
from bodycap_batch.check.check_report import CameraSummary, CheckReport
from bodycap_batch.check.file_mixups import require_distinct_videos
from bodycap_batch.check.overview import with_first_guess
from bodycap_batch.check.picture_quality import PictureQuality, check_picture_quality, stands_still
from bodycap_batch.check.recording_advice import advise
from bodycap_batch.config.bounds import MAX_TICKS
from bodycap_batch.config.export_targets import export_target
from bodycap_batch.config.job import load_job_with_origins
from bodycap_batch.config.models import (
    NO_SKELETON,
    SKELETON_PRESETS,
    CameraConfig,
    CaptureConfig,
    Job,
)
from bodycap_batch.config.mounts import TRUNK_ROLES
from bodycap_batch.config.origins import CameraOrigins
from bodycap_batch.config.overrides import Overrides
from bodycap_batch.config.rules import named_frames
from bodycap_batch.core.arrays import IntArray
from bodycap_batch.core.errors import (
    NO_MOTION_HINT,
    BodycapError,
    CaptureError,
    EstimationError,
    JobError,
    one_error,
)
from bodycap_batch.formats.bvh import RigOptions, read_rig
from bodycap_batch.formats.optional_libraries import require_formats
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.copied_frames import copied_notes
from bodycap_batch.model.nominal_mounts import require_limb
from bodycap_batch.store.disk_space import require_room

_RATE_TOLERANCE = 0.2
"""Maximum relative difference of a frame step from the median step for a fixed frame rate.

A frame step is the time between successive frames. Evidence: none.
"""
_MIN_DURATION_S = 2.0
"""Minimum duration (seconds) of a video that gives no note.

A shorter video hardly has enough motion for a map. Evidence: none.
"""
_MIN_UNIX_TIME_S = 1e8
"""Maximum time (seconds) that is treated as the time since the start of a video.

A larger time is treated as a Unix time. This value as a Unix time is in 1973.
"""


def check_path(path: Path, overrides: Overrides | None = None) -> CheckReport:
    """Check a job file or a folder of videos. Errors of the job are stored in the report and not raised."""
    try:
        loaded = load_job_with_origins(path, overrides)
    except (JobError, CaptureError) as error:
        if error.field == "capture.synthetic":
            note = (
                f"the videos of this sample capture have not been rendered yet; `bodycap run {path.name}` "
                "renders these videos first"
            )
            return CheckReport(notes=(note,))
        return CheckReport(errors=(error,))
    report = check_job(loaded.job, loaded.origins)
    settings = [f"settings from {loaded.job_file}"] if path.is_dir() and loaded.job_file is not None else []
    no_body = [loaded.no_body] if loaded.no_body else []
    return replace(
        report,
        notes=(*settings, *loaded.warnings, *no_body, *report.notes),
        unused_files=loaded.unused_files(),
    )


def require_ready(job: Job, threads: int = 1) -> CheckReport:
    """Check a resolved job before hours of computation, and raise one error with all problems.

    Disk space is not checked, because it changes while the job runs. Damaged frames are not searched: the
    selection of keyframes decodes all frames and finds them.

    Args:
        job: The resolved job.
        threads: Number of cameras that are inspected at the same time.

    Returns:
        The report of the check, without errors.

    Raises:
        BodycapError: A check found an error.
    """
    report = _run_checks(job, _CHECKS, threads, {})
    if report.errors:
        raise one_error(report.errors)
    return report


def check_job(job: Job, origins: Mapping[str, CameraOrigins] | None = None) -> CheckReport:
    """Run all checks of a resolved job, including disk space. If there are no errors, add advice.

    All frames are decoded once, to find damaged frames.

    Args:
        job: The resolved job.
        origins: Where the settings of each camera come from, by camera name; None if it is unknown.
    """
    checks = (*_CHECKS, _check_disk)
    report = _run_checks(job, checks, os.cpu_count() or 1, origins or {}, decode_all=True)
    return replace(report, advice=tuple(advise(job, report.cameras))) if report.ready else report


def _run_checks(
    job: Job,
    checks: Iterable[Callable[[Job, list[CameraSummary]], list[str]]],
    threads: int,
    origins: Mapping[str, CameraOrigins],
    *,
    decode_all: bool = False,
) -> CheckReport:
    errors: list[BodycapError] = []
    summaries: list[CameraSummary] = []
    pool = ThreadPoolExecutor(max_workers=threads)
    try:
        for look in [
            pool.submit(_check_camera, job.capture, config, origins.get(config.name), decode_all=decode_all)
            for config in job.capture.cameras
        ]:
            try:
                summaries.append(look.result())
            except CaptureError as error:
                errors.append(error)
    finally:  # if the user interrupts the check, do not wait for the remaining cameras
        pool.shutdown(cancel_futures=True)
    notes = _body_notes(job)
    for check in checks:
        try:
            notes += check(job, summaries)
        except BodycapError as error:
            errors.append(error)
    return CheckReport(job=job, cameras=tuple(summaries), notes=tuple(notes), errors=tuple(errors))


def _check_camera(
    capture: CaptureConfig, config: CameraConfig, origins: CameraOrigins | None, *, decode_all: bool
) -> CameraSummary:
    camera = open_camera(capture, config)
    camera = replace(camera, clock=ClockRelation(offset_s=config.offset_s or 0.0))
    quality = check_picture_quality(camera)
    if decode_all:
        damaged, pictures = find_damage_and_copies(camera)
        copies = [] if quality.is_static else copied_notes(camera.times_ns, pictures)
        quality = replace(quality, notes=(*quality.notes, *damage_notes(camera, damaged), *copies))
    summary = _summarise_camera(camera, config, quality)
    if origins is None:
        return summary
    return replace(summary, origins=with_first_guess(origins, config, camera.videos[0]))


def _summarise_camera(camera: CaptureCamera, config: CameraConfig, quality: PictureQuality) -> CameraSummary:
    times_s = camera.common_times_ns() / 1e9
    steps = np.diff(camera.times_ns)
    median_ns = float(np.median(steps)) if len(steps) else 0.0
    variable = len(steps) > 0 and bool((np.abs(steps - median_ns) > _RATE_TOLERANCE * median_ns).any())
    return CameraSummary(
        name=camera.name,
        role=config.role,
        files=tuple(path.name for path in camera.chapters),
        frames=sum(len(video.pts) for video in camera.videos),
        used_frames=len(camera.frame_numbers),
        used_runs=_frame_runs(camera.frame_numbers),
        start_s=float(times_s[0]),
        end_s=float(times_s[-1]),
        fps=camera.nominal_fps,
        variable_rate=variable,
        size_px=camera.videos[0].shown_size,
        work_size_px=(camera.camera.width_px, camera.camera.height_px),
        lens=_intrinsics_text(camera),
        guessed_lens=not camera.calibrated,
        is_static=quality.is_static,
        is_worn=config.is_worn,
        notes=(
            *camera.notes,
            *quality.notes,
            *_dropped_frame_notes(camera, median_ns),
            *setting_notes(camera, stabilised=config.stabilised),
            *calibration_notes(config, camera),
            *_intrinsics_notes(camera),
            *_duration_notes(float(times_s[-1] - times_s[0])),
        ),
    )


def _frame_runs(numbers: IntArray) -> tuple[tuple[int, int], ...]:
    """Return the first and the last frame number of each run of successive frame numbers."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return tuple((int(run[0]), int(run[-1])) for run in runs)


def _intrinsics_text(camera: CaptureCamera) -> str:
    width, focal = max(camera.camera.width_px, camera.camera.height_px), camera.camera.focal_px
    is_fisheye = camera.camera.model.endswith("FISHEYE")
    view = 2.0 * np.degrees(0.5 * width / focal if is_fisheye else np.arctan(0.5 * width / focal))
    aspect = camera.videos[0].pixel_aspect
    squared = "" if aspect == 1 else f"; the pixels of the video ({aspect} to 1) are made square"
    if camera.calibrated:
        return (
            f"the camera is calibrated: {camera.camera.model}, focal length {focal:.0f} px in the reduced "
            f"frames (long side: work_px){squared}"
        )
    return (
        "the camera is not calibrated: its lens is estimated together with the map; the first guess is a "
        f"field of view of {view:.0f}° along the long side{squared}"
    )


def _intrinsics_notes(camera: CaptureCamera) -> list[str]:
    lens = camera.camera
    long_side = max(lens.width_px, lens.height_px)
    notes = []
    if not 0.2 < lens.focal_px / long_side < 3.0:
        notes.append(
            f"the focal length is {lens.focal_px / long_side:.2f} times the long side of the picture, "
            "which is unusual; check that this calibration belongs to this camera"
        )
    centre_x, centre_y = lens.principal_point_px
    off = max(abs(centre_x / lens.width_px - 0.5), abs(centre_y / lens.height_px - 0.5))
    if off > 0.15:
        notes.append(
            f"the principal point is {100 * off:.0f} % of the picture size away from the centre; check "
            "that this calibration belongs to this camera"
        )
    return notes


def _dropped_frame_notes(camera: CaptureCamera, usual_ns: float) -> list[str]:
    """Return a note if frames were dropped; otherwise nothing.

    Dropped frames are found from the frame times and not from the nominal rate.

    Args:
        camera: The camera.
        usual_ns: Median time between successive frames, nanoseconds.
    """
    if usual_ns <= 0.0:
        return []
    lost = np.round(np.diff(camera.times_ns) / usual_ns) - 1
    lost = lost[lost > 0]
    if not len(lost):
        return []
    longest = (lost.max() + 1) * usual_ns / 1e9
    return [
        f"the camera dropped {int(lost.sum())} frames at {len(lost)} places of the video; the longest gap "
        f"is {longest:.2f} s"
    ]


def _duration_notes(duration_s: float) -> list[str]:
    if duration_s >= _MIN_DURATION_S:
        return []
    return [
        f"the video lasts only {duration_s:.1f} s, which is hardly enough movement for a map: use a longer "
        "part"
    ]


def _body_notes(job: Job) -> list[str]:
    if job.skeleton == NO_SKELETON:
        return []
    roles = {camera.role for camera in job.capture.worn()}
    notes = []
    if not roles & set(TRUNK_ROLES) and not job.capture.unplaced():
        notes.append(
            "no camera is on the trunk or the head, so the position of the body is only inferred from the "
            "limbs"
        )
    if job.height_m is None and job.skeleton in SKELETON_PRESETS:
        notes.append(
            "the height of the subject is not given (--height 1.75, or height_m in the job file), so the "
            "height of a mean adult is assumed; if it is wrong, all distances are wrong by the same factor"
        )
    return notes


def _check_clocks(job: Job, summaries: list[CameraSummary]) -> list[str]:
    """Check that each camera ran at the same time as at least one other camera.

    Cameras whose clock is to be estimated are not checked.
    """
    stated = {camera.name for camera in job.capture.cameras if camera.offset_s is not None}
    summaries = [camera for camera in summaries if camera.name in stated]
    if len(summaries) < 2:
        return []
    for camera in summaries:
        others = [other for other in summaries if other is not camera]
        if all(other.end_s <= camera.start_s or camera.end_s <= other.start_s for other in others):
            raise _no_common_time_error(job, camera, others)
    start, end = max(c.start_s for c in summaries), min(c.end_s for c in summaries)
    if end <= start:
        return ["there is no moment at which all cameras recorded"]
    return [
        f"all cameras recorded at the same time for {end - start:.1f} s, from {start:.2f} to {end:.2f} s "
        "on the common clock"
    ]


def _no_common_time_error(job: Job, camera: CameraSummary, others: list[CameraSummary]) -> CaptureError:
    config = next(c for c in job.capture.cameras if c.name == camera.name)
    clocks = {c.start_s > _MIN_UNIX_TIME_S for c in (camera, *others)}
    set_offset = "set offset_s of this camera (common time = camera time + offset_s)"
    mixed = "some cameras have Unix times as timestamps, other cameras have times that start near 0; "
    hint = mixed + set_offset if len(clocks) == 2 else set_offset
    first, last = min(o.start_s for o in others), max(o.end_s for o in others)
    return CaptureError(
        f"camera {camera.name} recorded from {camera.start_s:.2f} to {camera.end_s:.2f} s on the common "
        f"clock, but the other cameras recorded from {first:.2f} to {last:.2f} s",
        path=config.video[0],
        field="offset_s",
        hint=hint,
    )


def _check_rates(job: Job, summaries: list[CameraSummary]) -> list[str]:
    """Check that the rates that the job gives do not need too many ticks for the duration of the capture."""
    if job.skeleton == NO_SKELETON or not summaries:
        return []
    length_s = max(camera.end_s for camera in summaries) - min(camera.start_s for camera in summaries)
    for field, fps in (("merge.fps", job.merge.fps), ("export.fps", job.export.fps)):
        if fps is not None and length_s * fps > MAX_TICKS:
            raise JobError(
                f"{length_s:.0f} s at {fps:g} ticks per second are more than {MAX_TICKS} ticks",
                field=field,
                hint=f"at most {MAX_TICKS / length_s:.3g} for this capture, or cut it with start_s and end_s",
            )
    return []


def _check_skeleton(job: Job, _findings: list[CameraSummary]) -> list[str]:
    """Check that a skeleton file can be used and contains the bones that the cameras need."""
    if job.skeleton is None or job.skeleton in SKELETON_PRESETS:
        return []
    path = Path(job.skeleton)
    options = RigOptions(roles=job.skeleton_map, tpose_frame=job.tpose_frame, height_m=job.height_m)
    skeleton, _ = read_rig(path, options)
    for camera in job.capture.cameras:
        if camera.role is not None:
            require_limb(camera.name, camera.role, skeleton, path)
    findings = (*skeleton.notes, *(f"warning: {text}" for text in skeleton.warnings))
    return [
        f"skeleton {path.name}: {len(skeleton.joints)} joints",
        *(f"skeleton {path.name}: {text}" for text in findings),
    ]


def _check_formats(job: Job, _findings: list[CameraSummary]) -> list[str]:
    """Check that the libraries for the export formats are installed.

    Also check that the job does not rename the joints of a user's own skeleton.
    """
    require_formats(job.export.formats)
    if job.skeleton == NO_SKELETON:
        return []
    target = job.export.target
    of_target = None if target is None else export_target(target).options["names"]
    if job.export.names not in ("hik", of_target) and job.skeleton not in SKELETON_PRESETS:
        raise JobError(
            f"`names: {job.export.names}` cannot be used with a skeleton file, because the joints keep the "
            "names in the file",
            field="export.names",
            hint="leave out `names`, or use `skeleton: auto` or `skeleton: full_body`",
        )
    return []


def _check_named_frames(job: Job, summaries: list[CameraSummary]) -> list[str]:
    """Check that the frame numbers given in the job exist and belong to used frames."""
    known = {camera.name: camera for camera in summaries}
    for (block, field, _), camera, number in named_frames(job):
        finding = known.get(camera)
        if finding is None or any(first <= number <= last for first, last in finding.used_runs):
            continue
        if number >= finding.frames:
            raise JobError(
                f"camera {camera} has no frame {number}",
                field=f"{block}.{field}",
                hint=f"choose a frame from 0 to {finding.frames - 1} (the first frame of the video is 0)",
            )
        first, last = finding.used_runs[0][0], finding.used_runs[-1][1]
        raise JobError(
            f"frame {number} of camera {camera} is not used",
            field=f"{block}.{field}",
            hint=f"choose a frame from {first} to {last} (the first frame of the video is 0); only frames "
            "between start_s and end_s with usable times are used",
        )
    return []


def _check_files(job: Job, _findings: list[CameraSummary]) -> list[str]:
    """Check that no two cameras have the same video and that no chapter of a video is missing."""
    require_distinct_videos(job)
    return []


def _check_motion(job: Job, summaries: list[CameraSummary]) -> list[str]:
    """Check that at least one camera moves. A camera that seems to stand still is inspected more closely."""
    if len(summaries) < len(job.capture.cameras) or not all(camera.is_static for camera in summaries):
        return []
    if not all(stands_still(open_camera(job.capture, config)) for config in job.capture.cameras):
        return []
    raise EstimationError(
        "no camera moves: the pictures of "
        + (f"all {len(summaries)} cameras stand" if len(summaries) > 1 else f"{summaries[0].name} stand")
        + " still throughout, so there is no motion and no map",
        field="capture.cameras",
        hint=NO_MOTION_HINT,
    )


def _check_disk(job: Job, summaries: list[CameraSummary]) -> list[str]:
    """Check that the disk has space for results and intermediate files, and that files can be written."""
    frames = sum(camera.used_frames for camera in summaries)
    large = sum(camera.large_frames for camera in summaries)
    return require_room(job.out or Path("out").resolve(), frames, large)


_CHECKS = (
    _check_files,
    _check_motion,
    _check_clocks,
    _check_rates,
    _check_named_frames,
    _check_skeleton,
    _check_formats,
)
