"""Inputs that several tasks share: references to artefacts and files, the videos, the body."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from bodycap_batch.config.models import Activity, CaptureConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ArtefactRef:
    """A stored artefact that a task reads.

    Attributes:
        path: Folder of the artefact.
        digest: Digest of the artefact's content.
    """

    path: Path
    digest: str

    def key_content(self) -> str:
        """Return the digest only: the place where the artefact is stored does not change a result."""
        return self.digest


@dataclass(frozen=True, slots=True, kw_only=True)
class FileRef:
    """A user's file that a task reads.

    Attributes:
        path: Path of the file.
        digest: SHA-256 of the file's bytes.
    """

    path: Path
    digest: str

    def key_content(self) -> str:
        """Return the digest only: the place where the file is stored does not change a result."""
        return self.digest


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureRef:
    """The cameras that a task reads, with their videos.

    Attributes:
        config: The resolved capture block of the job, with the task's cameras only.
        digests: For each camera name, the digest of everything that the camera's frames depend on. Empty if a
            video cannot be read.
    """

    config: CaptureConfig
    digests: Mapping[str, str]

    def key_content(self) -> Mapping[str, str]:
        """Return the digest of each camera only: where the videos are stored does not change a result."""
        return self.digests


@dataclass(frozen=True, slots=True, kw_only=True)
class StatedClock:
    """What the job and the calibration file state about the clock of one camera.

    Attributes:
        offset_s: Stated offset, seconds; None if it is to be estimated.
        drift_ppm: Stated drift, parts per million; None if it is to be estimated.
        role: Role of the bone that the camera is mounted on; None if it is unknown.
    """

    offset_s: float | None
    drift_ppm: float | None
    role: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class MountInput:
    """The place on the body at which a camera is mounted, as the job gives it.

    Attributes:
        camera: Camera name.
        role: Role of the bone that the camera is mounted on (``LeftHand``).
        place: Name of the place on the body (the job's `mount`, else the camera name).
        joint_from_cam: The measured mount: the rows of a 4x4 transform from camera to joint coordinates
            (metres). None if the mount was not measured.
        sigma_deg: Standard deviation (degrees) of the mount's rotation about each axis; None if the job does
            not give it.
        sigma_m: Standard deviation (metres) of the mount's position along each axis; None if the job does not
            give it.
    """

    camera: str
    role: str
    place: str
    joint_from_cam: tuple[tuple[float, ...], ...] | None
    sigma_deg: float | None
    sigma_m: float | None


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyInput:
    """The body of a job: skeleton, stature, activity and mounts.

    Attributes:
        skeleton: Name of a skeleton preset; None if the job names a skeleton file.
        skeleton_file: The user's BVH file; None if the job names a preset.
        skeleton_map: Role of each joint that the user assigns, by joint name in the skeleton file.
        tpose_frame: Index of the skeleton file's frame that shows the T-pose; None if the zero pose, or the
            frame that is nearest to a T-pose, is used.
        height_m: Stature (metres) of the subject; None if the job does not give it.
        activity: The activity of the subject.
        mounts: The mount of each camera.
    """

    skeleton: str | None
    skeleton_file: FileRef | None
    skeleton_map: Mapping[str, str]
    tpose_frame: int | None
    height_m: float | None
    activity: Activity
    mounts: tuple[MountInput, ...]


def stated_clocks(capture: CaptureConfig) -> dict[str, StatedClock]:
    """Return what is stated about the clock of each camera, by camera name."""
    return {
        camera.name: StatedClock(offset_s=camera.offset_s, drift_ppm=camera.drift_ppm, role=camera.role)
        for camera in capture.cameras
    }


def paths_of(artefacts: Iterable[ArtefactRef]) -> list[Path]:
    """Return the folder of each artefact."""
    return [artefact.path for artefact in artefacts]
