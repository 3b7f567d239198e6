"""Create the inputs of the stages' tasks from a job and its stored artefacts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bodycap_batch.capture.video import MAY_READ
from bodycap_batch.config.folder import VIDEO_SUFFIXES
from bodycap_batch.config.models import CameraConfig, CaptureConfig, Job
from bodycap_batch.core.errors import Cancelled, CaptureError, JobError
from bodycap_batch.core.progress import Event, Listener
from bodycap_batch.store.artefacts import DISK_ERRORS, Artefact, store_error
from bodycap_batch.store.digests import FileDigests, json_digest
from bodycap_batch.tasks.inputs import ArtefactRef, BodyInput, CaptureRef, FileRef, MountInput

_FILE_FIELDS = ("video", "timestamps", "samples", "mask")
_CLOCK_FIELDS = ("offset_s", "drift_ppm")
"""Fields that describe a camera's clock. The frames of a camera depend on them only if start_s or end_s
selects frames; a new offset then changes the selected frames."""
_MOUNT_FIELDS = ("mount", "mount_source", "segment", "joint_from_cam", "sigma_deg", "sigma_m")
"""Fields that describe a camera's mount on the body. Only the skeleton depends on them, so they are not part
of a camera's digest."""


def camera_digest(
    capture: CaptureConfig,
    camera: CameraConfig,
    digests: FileDigests,
    on_bytes: Callable[[int], None] | None = None,
) -> str:
    """Return the digest of what a camera's frames depend on: files, clock, intrinsics, time window.

    Args:
        capture: The capture block of the job.
        camera: A camera of this block.
        digests: Cache of the digests of files.
        on_bytes: Called with the number of bytes after each block that is read.

    Raises:
        CaptureError: A file cannot be read.
        StoreError: The disk fails (`DiskAway` if the disk does not answer).
    """
    omitted: dict[str, Any] = dict.fromkeys((*_FILE_FIELDS, *_MOUNT_FIELDS), True)
    if capture.start_s is None and capture.end_s is None:
        omitted |= dict.fromkeys(_CLOCK_FIELDS, True)
    omitted["calibration"] = {"calibrated_with"}
    settings = camera.model_dump(mode="json", exclude=omitted)
    shared = capture.model_dump(mode="json", include={"start_s", "end_s", "work_px"})
    content = [_footage_digest(path, digests, on_bytes) for path in camera.input_files()]
    return json_digest(
        {
            **settings,
            **shared,
            "files": content,
            "chapters": len(camera.video),
            "mask": camera.mask is not None,
        }
    )


def camera_digests(
    capture: CaptureConfig, digests: FileDigests, listener: Listener, cancelled: Callable[[], bool]
) -> dict[str, str]:
    """Return the `camera_digest` of each camera, by name, and report the progress of reading the videos.

    Raises:
        Cancelled: The job was stopped while files were read.
        CaptureError, StoreError: See `camera_digest`.
    """
    videos = [path for camera in capture.cameras for path in camera.video]
    total = sum(path.stat().st_size for path in videos if path.exists())
    read = 0

    def on_bytes(count: int) -> None:
        nonlocal read
        read = min(read + count, total)
        if cancelled():
            raise Cancelled("the job stopped on request", hint="run the job again to continue")
        report()

    def report() -> None:
        done, all_mb = round(read / 2**20), round(total / 2**20)
        listener(Event(kind="progress", stage="reading videos", done=done, total=all_mb, what="MB"))

    found = {camera.name: camera_digest(capture, camera, digests, on_bytes) for camera in capture.cameras}
    if read:  # the digests of some videos may have been known
        read = total
        report()
    return found


def _footage_digest(path: Path, digests: FileDigests, on_bytes: Callable[[int], None] | None) -> str:
    try:
        return digests.sha256(path, on_bytes)
    except FileNotFoundError as error:
        what = "video file" if path.suffix.lower() in VIDEO_SUFFIXES else "file"
        raise CaptureError(
            f"there is no such {what}", path=path, hint=f"correct the path of the {what}"
        ) from error
    except OSError as error:
        if error.errno in DISK_ERRORS:
            raise store_error(error, path) from error
        raise CaptureError(f"cannot be read: {error.strerror}", path=path, hint=MAY_READ) from error


def capture_ref(
    capture: CaptureConfig, digests: Mapping[str, str], cameras: Sequence[CameraConfig] | None = None
) -> CaptureRef:
    """Return the reference to the videos of a capture, as input of a task.

    Args:
        capture: The capture block of the job.
        digests: The `camera_digest` of each camera, by camera name; empty if a video cannot be read.
        cameras: The cameras of the task, in the order that the task needs; None for all cameras.
    """
    chosen = capture.cameras if cameras is None else tuple(cameras)
    config = capture.model_copy(update={"cameras": chosen, "synthetic": None})
    return CaptureRef(
        config=config,
        digests={camera.name: digests[camera.name] for camera in chosen if camera.name in digests},
    )


def artefact_ref(artefact: Artefact) -> ArtefactRef:
    """Return the reference to a stored artefact, as input of a task."""
    return ArtefactRef(path=artefact.path, digest=artefact.digest)


def optional_ref(artefact: Artefact | None) -> ArtefactRef | None:
    """Return the reference to a stored artefact, as input of a task; None if there is no artefact."""
    return None if artefact is None else artefact_ref(artefact)


def refs_by_camera(artefacts: Mapping[str, Artefact]) -> dict[str, ArtefactRef]:
    """Return the reference to the artefact of each camera, by camera name, as input of a task."""
    return {name: artefact_ref(artefact) for name, artefact in artefacts.items()}


def samples_input(camera: CameraConfig, digests: FileDigests) -> FileRef | None:
    """Return the file with the inertial samples of a camera, as input of a task.

    Returns:
        The file; None if there is none.

    Raises:
        CaptureError: The file cannot be read.
        StoreError: The disk fails.
    """
    path = camera.samples
    return None if path is None else FileRef(path=path, digest=_footage_digest(path, digests, None))


def body_input(job: Job, digests: FileDigests) -> BodyInput:
    """Return the body of a job as input of a task: skeleton, stature, activity and mounts.

    Cameras that nobody wears, and those whose place the run finds later, have no mount.

    Raises:
        JobError: A camera's place on the body is unknown, or the skeleton file cannot be read.
        StoreError: The disk fails.
    """
    path, unplaced = skeleton_file(job), job.capture.unplaced()
    return BodyInput(
        skeleton=None if path else job.skeleton,
        skeleton_file=None if path is None else FileRef(path=path, digest=_skeleton_digest(path, digests)),
        skeleton_map=dict(job.skeleton_map) if path else {},
        tpose_frame=job.tpose_frame if path else None,
        height_m=job.height_m,
        activity=job.activity,
        mounts=tuple(_mount_input(camera) for camera in job.capture.worn() if camera not in unplaced),
    )


def _skeleton_digest(path: Path, digests: FileDigests) -> str:
    try:
        return digests.sha256(path)
    except OSError as error:
        if error.errno in DISK_ERRORS:
            raise store_error(error, path) from error
        raise JobError(
            f"cannot be read: {error.strerror}", path=path, field="skeleton", hint=MAY_READ
        ) from error


def has_body(job: Job) -> bool:
    """Return True if the job asks for a skeleton."""
    return job.skeleton not in (None, "none")


def skeleton_file(job: Job) -> Path | None:
    """Return the path of the user's BVH file; None if the job names no BVH file."""
    named = job.skeleton or ""
    return Path(named) if named.lower().endswith(".bvh") else None


def _mount_input(camera: CameraConfig) -> MountInput:
    if camera.role is None:
        raise JobError(
            f"the place of camera {camera.name!r} on the body is unknown",
            field=f"capture.cameras.{camera.name}.mount",
            hint="add the place of the camera, for example `mount: torso`, or set `skeleton: none`",
        )
    stated = camera.mount_matrix()
    return MountInput(
        camera=camera.name,
        role=camera.role,
        place=camera.mount or camera.name,
        joint_from_cam=None if stated is None else tuple(tuple(row) for row in stated.tolist()),
        sigma_deg=camera.sigma_deg,
        sigma_m=camera.sigma_m,
    )
