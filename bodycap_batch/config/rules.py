"""Rules that check a whole job after the type of each field has been checked.

The rules concern names, mounts, skeleton, times, rig and marker board.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bodycap_batch.config.explain import Problem
from bodycap_batch.config.models import (
    AUTO_SKELETON,
    NO_SKELETON,
    SKELETON_PRESETS,
    CameraConfig,
    Job,
    MountPose,
)
from bodycap_batch.config.mounts import MOTION_PLACES, MOUNT_NAMES, ROLES, mount_of
from bodycap_batch.config.options import MARKER_COUNTS
from bodycap_batch.model.skeleton_presets import split_side

_FREE_LIMB = {"Arm": "arm", "ForeArm": "arm", "Hand": "arm", "Leg": "leg", "Foot": "leg"}
"""Limb (arm or leg) that a bone belongs to, by the bone's role without its side. Only bones that move freely
relative to the trunk are listed."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._\-]*")
_NAME_CHARACTERS = "letters, digits, ., _ and - only, first a letter or a digit"
UNKNOWN_MOUNT = "<where on the body?>"
"""Placeholder that `bodycap init` writes for a mount that the file name of the camera does not contain."""
_UNKNOWN_VIDEO = "<path of your camera.mp4>"
"""Placeholder for the video in the job file ``jobs/tum_rgbd.yaml``."""
_MAX_NAME_BYTES = 255
"""Maximum length (bytes) of a file name on common file systems."""
_ROTATION_TOLERANCE = 5e-3
"""Maximum deviation (no unit) of a rotation given in the job. For a matrix R, it limits the deviation of each
element of R·Rᵀ from the identity; for a quaternion, the deviation of the length from 1. Rounding to three
decimals causes smaller deviations."""


def problems_in(job: Job) -> list[Problem]:
    """Check a job by all rules of this module and return the problems. No file is opened."""
    problems: list[Problem] = []
    for index, camera in enumerate(job.capture.cameras):
        for found in (*_camera_names(job, index), *_mount(job, camera), *_pose(camera), *_paths(camera)):
            problems.append(found._replace(location=("capture", "cameras", index, *found.location)))
    rules = (_job_names, _files, _skeleton, _size, _times, _named_frames, _places, _rig, _board)
    return [*problems, *(found for rule in rules for found in rule(job))]


def skeleton_of(job: Job) -> str:
    """Return the skeleton of a job.

    A job without a skeleton gets a default. The default is ``none`` if all cameras are mounted on one bone;
    otherwise it is ``auto``.
    """
    if job.skeleton is not None:
        return AUTO_SKELETON if job.skeleton == "upper_body" else job.skeleton
    worn = job.capture.worn()
    roles = {camera.role for camera in worn}
    alone = len(worn) <= 1 or (len(roles) == 1 and None not in roles)
    return NO_SKELETON if alone else AUTO_SKELETON


def _camera_names(job: Job, index: int) -> Iterator[Problem]:
    name = job.capture.cameras[index].name
    if not _NAME.fullmatch(name):
        yield Problem(("name",), f"{name!r} cannot be a file's name", _NAME_CHARACTERS)
    for other in job.capture.cameras[:index]:
        if other.name.lower() == name.lower():
            yield Problem(
                ("name",),
                f"two cameras have the name {name!r}",
                "give each camera a different name; two cameras on one segment can have the names torso "
                "and torso_back",
            )
        elif set(other.video) & set(job.capture.cameras[index].video):
            yield Problem(
                ("video",),
                f"this camera has the same video as camera {other.name!r}",
                "give each camera its own video",
            )


def _mount(job: Job, camera: CameraConfig) -> Iterator[Problem]:
    if not camera.is_worn:
        for field in ("segment", "joint_from_cam"):
            if getattr(camera, field) is not None:
                message = f"camera {camera.name!r} is not on the body (mount: none), so it is on no bone"
                yield Problem((field,), message, f"remove {field}, or give the camera's place as `mount:`")
    elif camera.segment is not None and camera.role is None:
        known = (*ROLES, *MOUNT_NAMES)
        yield Problem(
            ("segment",), f"there is no segment {camera.segment!r}", _nearest(camera.segment, known)
        )
    elif camera.mount == UNKNOWN_MOUNT:
        message = f"the place of camera {camera.name!r} on the body is not filled in"
        yield Problem(("mount",), message, f"use one of {', '.join(MOUNT_NAMES)}, or none")
    elif camera.segment is None and camera.mount is not None and camera.role is None:
        yield Problem(("mount",), f"there is no mount {camera.mount!r}", _nearest(camera.mount, MOUNT_NAMES))
    elif camera.role is None and skeleton_of(job) != NO_SKELETON and not job.capture.places:
        near = [*difflib.get_close_matches(camera.name, MOUNT_NAMES, n=1), "torso"][0]
        yield Problem(
            (),
            f"the place of camera {camera.name!r} on the body is unknown, because the camera's name does "
            "not contain a place",
            f"add `mount:` with the place, for example `mount: {near}` (use one of "
            f"{', '.join(MOUNT_NAMES)}), or set `skeleton: none`",
        )


def _pose(camera: CameraConfig) -> Iterator[Problem]:
    where = ("joint_from_cam",)
    if isinstance(camera.joint_from_cam, MountPose):
        if abs(np.linalg.norm(camera.joint_from_cam.quat_xyzw) - 1.0) > _ROTATION_TOLERANCE:
            yield Problem(
                (*where, "quat_xyzw"),
                "the length of the quaternion is not 1",
                "write the quaternion in the order x, y, z, w, with length 1",
            )
        return
    matrix = camera.mount_matrix()
    if matrix is None:
        return
    rotation = matrix[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > _ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        yield Problem(
            where,
            "the upper left 3×3 block is not a rotation",
            "write the rows of an orthonormal 3×3 matrix with determinant +1",
        )
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        yield Problem(
            where,
            "the last row of the matrix is not 0, 0, 0, 1",
            "write four rows, with the translation in the last column and 0, 0, 0, 1 as the last row",
        )


def _paths(camera: CameraConfig) -> Iterator[Problem]:
    for video in camera.video:
        if str(video) == _UNKNOWN_VIDEO:
            message = f"the path of the video is not filled in: {video}"
            yield Problem(("video",), message, "write the path of your video here")
    if len(set(camera.video)) < len(camera.video):
        yield Problem(("video",), "a chapter is listed twice", "list each file once")


def _files(job: Job) -> Iterator[Problem]:
    """Yield a problem for each path that common file systems do not accept."""
    out = [] if job.out is None else [(("out",), job.out)]
    for where, path in (*out, *job.files()):
        is_long = any(len(part.encode(errors="replace")) > _MAX_NAME_BYTES for part in path.parts)
        if "\0" in str(path) or is_long:
            yield Problem(where, f"{str(path)[:40]!r} cannot be a path", "correct the path")


def _job_names(job: Job) -> Iterator[Problem]:
    if job.name and not _NAME.fullmatch(job.name):
        yield Problem(("name",), f"{job.name!r} cannot be a folder's name", _NAME_CHARACTERS)


def _skeleton(job: Job) -> Iterator[Problem]:
    value = job.skeleton
    if value is not None and value not in SKELETON_PRESETS and not value.lower().endswith(".bvh"):
        hint = _nearest(value, SKELETON_PRESETS)
        yield Problem(
            ("skeleton",), f"there is no skeleton {value!r}", f"{hint}; or give the path of a .bvh file"
        )
    roles = {camera.role for camera in job.capture.worn()}
    if skeleton_of(job) != NO_SKELETON and not roles:
        yield Problem(
            ("skeleton",),
            "nobody wears a camera (mount: none), so there is no motion of a body",
            "give the places of the worn cameras, or set `skeleton: none`",
        )
    if skeleton_of(job) != NO_SKELETON and len(roles) == 1 and None not in roles:
        yield Problem(
            ("skeleton",),
            f"every camera is on {roles.pop()}; the motion of a body needs cameras on two bones or more",
            "add a camera on another bone, or set `skeleton: none` to compute only the map and the paths "
            "of the cameras",
        )


def _size(job: Job) -> Iterator[Problem]:
    """Yield a problem if every camera is mounted on a different limb.

    In this case no distance between cameras determines the size of the body.
    """
    worn = job.capture.worn()
    parts = [split_side(camera.role) for camera in worn if camera.role is not None]
    limbs = [(side, _FREE_LIMB.get(part)) for side, part in parts]
    all_differ = len(limbs) == len(set(limbs)) == len(worn) > 1
    if skeleton_of(job) != NO_SKELETON and all_differ and all(limb is not None for _, limb in limbs):
        yield Problem(
            ("skeleton",),
            "these cameras do not determine the size of the body, because each camera is on a different limb",
            "add a camera on the trunk or the head (for example torso), or a second camera on one of the "
            "limbs; or set `skeleton: none` to compute only the map and the paths of the cameras",
        )


def _times(job: Job) -> Iterator[Problem]:
    start, end = job.capture.start_s, job.capture.end_s
    if start is not None and end is not None and end <= start:
        yield Problem(
            ("capture", "end_s"),
            f"end_s {end:g} is not after start_s {start:g}",
            "exchange start_s and end_s, or correct one of these times",
        )


def _places(job: Job) -> Iterator[Problem]:
    """Yield a problem if the run cannot find the places of the cameras from the motion."""
    capture = job.capture
    unplaced = capture.unplaced()
    where = ("capture", "places")
    for place in capture.places:
        if mount_of(place) is None:
            yield Problem(where, f"there is no place {place!r} on the body", _nearest(place, MOUNT_NAMES))
            return
    if not unplaced or skeleton_of(job) == NO_SKELETON:
        return
    mounts = [mount_of(camera.mount or camera.name) for camera in capture.cameras]
    stated = [found[0] for found in mounts if found is not None]
    given = [found[0] for place in capture.places if (found := mount_of(place)) is not None]
    every = [*stated, *(place for place in given if place not in stated)]
    if sorted(every) != sorted(MOTION_PLACES) or len(capture.cameras) != len(MOTION_PLACES):
        yield Problem(
            where,
            "the program can find from the motion only which of three cameras was on "
            f"{', '.join(MOTION_PLACES[:-1])} and {MOTION_PLACES[-1]}; this job has {len(capture.cameras)} "
            f"cameras, on {', '.join(every)}",
            "give the place of each camera, for example --camera "
            f"{unplaced[0].name}={MOTION_PLACES[0]}, or `mount: {MOTION_PLACES[0]}` in the job file",
        )
    if capture.start_s is not None or capture.end_s is not None:
        yield Problem(
            where,
            "start_s and end_s are times on the clock of the torso's camera, and it is not known which "
            "camera that is",
            "leave out start_s and end_s, or give the place of each camera",
        )


def _rig(job: Job) -> Iterator[Problem]:
    """Yield a problem if a job has a synchronised rig, but no two cameras on the same body segment."""
    if job.capture.rig == "synced" and not job.capture.segments():
        message = "`synced` needs two cameras on one segment, but no two cameras share a segment"
        yield Problem(
            ("capture", "rig"), message, "give two cameras the same `mount` or `segment`, or leave out `rig`"
        )


def missing_files(job: Job, base: Path) -> list[Problem]:
    """Return a problem for each file of a job that does not exist.

    Args:
        job: The job.
        base: Folder to which the paths of the job are relative.
    """
    missing = [(where, base / path) for where, path in job.files() if not _exists(base / path)]
    return [Problem(where, f"there is no such file: {path}", "correct the path") for where, path in missing]


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # a name that is too long is reported by another rule
        return True


def named_frames(job: Job) -> Iterator[tuple[tuple[str, str, int], str, int]]:
    """Yield each frame that a job names: the location of its field, the camera name and the frame number."""
    distance = job.merge.known_distance
    for block, field, frames in (
        ("map", "init_frames", job.map.init_frames or ()),
        ("merge", "known_distance", distance[:2] if distance else ()),
    ):
        for index, frame in enumerate(frames):
            camera, _, number = frame.rpartition(":")
            yield (block, field, index), camera, int(number)


def _named_frames(job: Job) -> Iterator[Problem]:
    """Yield a problem for each named frame whose camera is not a camera of the job."""
    names = tuple(camera.name for camera in job.capture.cameras)
    for where, camera, _ in named_frames(job):
        if camera not in names:
            yield Problem(where, f"there is no camera {camera[:40]!r}", _nearest(camera, names))


def _board(job: Job) -> Iterator[Problem]:
    """Yield a problem if a marker board cannot be detected, or looks the same after a rotation by 90°."""
    board, where = job.merge.marker_board, ("merge", "marker_board")
    if board is None:
        return
    size = f"{board.columns}x{board.rows}"
    if board.kind == "chessboard":
        if board.columns == board.rows:
            same = f"a chessboard of {size} looks the same from all four sides"
            yield Problem(where, same, "use a board with one row more than columns, or a ChArUco board")
        return
    if min(board.columns, board.rows) < 4:
        small = f"a ChArUco board of {size} squares has too few corners"
        yield Problem(
            where,
            small,
            "use a board with at least four columns and four rows, for example 7 columns and 5 rows",
        )
    count = MARKER_COUNTS.get(board.dictionary.upper().removeprefix("DICT_"))
    if count is None:
        nearest = _nearest(board.dictionary, tuple(MARKER_COUNTS))
        yield Problem(
            (*where, "dictionary"), f"there is no family of markers {board.dictionary[:40]!r}", nearest
        )
    elif board.columns * board.rows // 2 > count:
        many = f"a ChArUco board of {size} squares needs more markers than the family {board.dictionary} has"
        yield Problem(
            (*where, "dictionary"),
            many,
            "give the family of the markers on your printed board, which must be a larger family",
        )


def _nearest(value: str, known: tuple[str, ...]) -> str:
    near = difflib.get_close_matches(value.lower(), [word.lower() for word in known], n=1)
    if not near:
        return f"use one of {', '.join(known)}"
    return f"did you mean {next(word for word in known if word.lower() == near[0])!r}?"
