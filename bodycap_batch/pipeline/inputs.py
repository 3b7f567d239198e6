"""What each stage is made from: digests for the store's keys, arguments for the child."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from bodycap_batch.capture.video import MAY_READ
from bodycap_batch.config.models import CameraConfig, CaptureConfig, Job
from bodycap_batch.core.errors import Cancelled, CaptureError, JobError
from bodycap_batch.core.progress import Event, Listener
from bodycap_batch.store.artefacts import DISK_ERRORS, Artefact, ArtefactKey, store_error
from bodycap_batch.store.code_version import algorithm_version, library_versions
from bodycap_batch.store.digests import FileDigests, json_digest
from bodycap_batch.tasks import STAGES, read_summary

_FILES = ("video", "timestamps", "mask")
_BODY = ("mount", "segment", "joint_from_cam", "sigma_deg", "sigma_m")
"""Fields about where a camera sits: they matter to the skeleton only."""


def key_of(stage: str, options: Mapping[str, Any], inputs: Mapping[str, Any]) -> ArtefactKey:
    """Key of an artefact of `stage`."""
    entry = STAGES[stage]
    return ArtefactKey(
        stage=stage,
        algorithm=algorithm_version(entry.code),
        options=dict(options),
        inputs=dict(inputs),
        libraries=library_versions(entry.libraries),
    )


def camera_digest(
    capture: CaptureConfig,
    camera: CameraConfig,
    digests: FileDigests,
    on_bytes: Callable[[int], None] | None = None,
) -> str:
    """Digest of all that decides what a camera's frames are: bytes of its files, clock, lens, window.

    Raises:
        CaptureError: A file cannot be read.
        StoreError: The disk fails; `DiskAway` where it does not answer.
    """
    settings = camera.model_dump(mode="json", exclude=set(_FILES + _BODY))
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
    """By camera, `camera_digest`; tells how far reading the videos is.

    Raises:
        Cancelled: Asked to stop meanwhile.
        CaptureError, StoreError: See `camera_digest`.
    """
    videos = [path for camera in capture.cameras for path in camera.video]
    total = sum(path.stat().st_size for path in videos if path.exists())
    read = 0

    def on_bytes(count: int) -> None:
        nonlocal read
        read += count
        if cancelled():
            raise Cancelled("stopped on request", hint="run it again to go on")
        listener(
            Event(kind="progress", stage="reading videos", done=read >> 20, total=total >> 20, what="MB")
        )

    return {camera.name: camera_digest(capture, camera, digests, on_bytes) for camera in capture.cameras}


def _footage_digest(path: Path, digests: FileDigests, on_bytes: Callable[[int], None] | None) -> str:
    try:
        return digests.sha256(path, on_bytes)
    except FileNotFoundError as error:
        raise CaptureError("there is no such file", path=path, hint="check the path") from error
    except OSError as error:
        if error.errno in DISK_ERRORS:
            raise store_error(error, path) from error
        raise CaptureError(f"cannot be read: {error.strerror}", path=path, hint=MAY_READ) from error


def one_camera(capture: CaptureConfig, camera: CameraConfig) -> dict[str, Any]:
    """The capture block with a single camera, as JSON values."""
    return capture.model_copy(update={"cameras": (camera,), "synthetic": None}).model_dump(mode="json")


def all_cameras(capture: CaptureConfig) -> dict[str, Any]:
    """The capture block as JSON values."""
    return capture.model_copy(update={"synthetic": None}).model_dump(mode="json")


def body_arguments(job: Job) -> dict[str, Any]:
    """Skeleton, stature, activity and mounts, as the merge task takes them.

    Raises:
        JobError: A camera's place on the body is not known.
    """
    path = skeleton_file(job)
    return {
        "skeleton": None if path else job.skeleton,
        "skeleton_file": str(path) if path else None,
        "skeleton_map": dict(job.skeleton_map) if path else {},
        "tpose_frame": job.tpose_frame if path else None,
        "height_m": job.height_m,
        "activity": job.activity,
        "mounts": [_mount_block(camera) for camera in job.capture.cameras],
    }


def merge_arguments(job: Job, keyframes: Mapping[str, Artefact]) -> dict[str, Any]:
    """The body, and the videos and their kept pictures where the merge looks for a board in them.

    Raises:
        JobError: A camera's place on the body is not known.
    """
    if job.merge.marker_board is None:
        return body_arguments(job)
    return {**body_arguments(job), "capture": all_cameras(job.capture), "kept": kept_in(keyframes)}


def body_digest(job: Job, digests: FileDigests) -> dict[str, Any]:
    """The same with the skeleton file's content in the place of its path.

    Raises:
        JobError: The file cannot be read.
        StoreError: The disk fails.
    """
    path = skeleton_file(job)
    try:
        content = digests.sha256(path) if path else None
    except OSError as error:
        if path is not None and error.errno in DISK_ERRORS:
            raise store_error(error, path) from error
        raise JobError(
            f"cannot be read: {error.strerror}", path=path, field="skeleton", hint=MAY_READ
        ) from error
    return {**body_arguments(job), "skeleton_file": content}


def has_body(job: Job) -> bool:
    """False where the job asks for no skeleton."""
    return job.skeleton not in (None, "none")


def skeleton_file(job: Job) -> Path | None:
    """The user's BVH file, if the job names one."""
    named = job.skeleton or ""
    return Path(named) if named.lower().endswith(".bvh") else None


def _mount_block(camera: CameraConfig) -> dict[str, Any]:
    if camera.role is None:
        raise JobError(
            f"where on the body is camera {camera.name!r}?",
            field=f"capture.cameras.{camera.name}.mount",
            hint="name its mount, e.g. `mount: torso`, or set `skeleton: none`",
        )
    stated = camera.mount_matrix()
    return {
        "camera": camera.name,
        "role": camera.role,
        "place": camera.mount or camera.name,
        "joint_from_cam": None if stated is None else stated.tolist(),
        "sigma_deg": camera.sigma_deg,
        "sigma_m": camera.sigma_m,
    }


def content_of(artefacts: Mapping[str, Artefact]) -> dict[str, str]:
    """Digests of artefacts by camera."""
    return {name: artefact.digest for name, artefact in artefacts.items()}


def kept_in(keyframes: Mapping[str, Artefact]) -> dict[str, str]:
    """By camera, the artefact that keeps frames of its video."""
    return {name: str(artefact.path) for name, artefact in keyframes.items()}


def localised_in(registrations: Mapping[str, Artefact]) -> int:
    """Localised frames of all cameras."""
    return sum(int(read_summary(item.path)["localised"]) for item in registrations.values())


def beside_others(
    capture: CaptureConfig,
    cameras: Sequence[CameraConfig],
    digests: Mapping[str, str],
    scene: Artefact,
    keyframes: Mapping[str, Artefact],
    registrations: Mapping[str, Artefact],
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Inputs of the key and arguments of a task that solves a camera's frames with those of others.

    Args:
        capture: All cameras.
        cameras: The task's own camera, then the others.
        digests: By camera, of what its frames are.
        scene: The map.
        keyframes: By camera.
        registrations: By camera.
    """
    found = {camera.name: registrations[camera.name] for camera in cameras}
    inputs = {
        "cameras": [digests[name] for name in found],
        "map": scene.digest,
        "keyframes": [keyframes[name].digest for name in found],
        "registrations": list(content_of(found).values()),
    }
    arguments = {
        "capture": all_cameras(capture.model_copy(update={"cameras": tuple(cameras)})),
        "map": str(scene.path),
        "selection": str(keyframes[cameras[0].name].path),
        "kept": kept_in({name: keyframes[name] for name in found}),
        "registrations": [str(artefact.path) for artefact in found.values()],
    }
    return inputs, arguments
