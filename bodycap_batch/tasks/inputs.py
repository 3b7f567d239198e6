"""Inputs that several tasks share: references to artefacts and files, the videos, the body."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bodycap_batch.config.models import Activity, CaptureConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class ArtefactRef:
    """A stored artefact that a task reads.

    Attributes:
        path: Folder of the artefact.
        digest: Digest of its content.
    """

    path: Path
    digest: str

    def key_content(self) -> str:
        """Return the digest: where the artefact is stored does not change a result."""
        return self.digest


@dataclass(frozen=True, slots=True, kw_only=True)
class FileRef:
    """A file of the user that a task reads.

    Attributes:
        path: The file.
        digest: SHA-256 of its bytes.
    """

    path: Path
    digest: str

    def key_content(self) -> str:
        """Return the digest: where the file lies does not change a result."""
        return self.digest


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureRef:
    """The cameras that a task reads, with their videos.

    Attributes:
        config: The resolved capture block, with the task's cameras only.
        digests: By camera name, the digest of everything that its frames depend on. Empty if a video cannot
            be read.
    """

    config: CaptureConfig
    digests: Mapping[str, str]

    def key_content(self) -> dict[str, Any]:
        """Return the digest of each camera."""
        return dict(self.digests)


@dataclass(frozen=True, slots=True, kw_only=True)
class MountInput:
    """Where a job says that a camera is mounted.

    Attributes:
        camera: Camera name.
        role: Role of the bone that carries it (``LeftHand``).
        place: Name of the place on the body, as the job gives it.
        joint_from_cam: The measured mount, a 4x4 transform row by row; None if it was not measured.
        sigma_deg: Standard deviation of the rotation per axis, if the job states it.
        sigma_m: Standard deviation of the position per axis, if the job states it.
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
        skeleton: Name of a preset; None if the job names a skeleton file.
        skeleton_file: The user's BVH file, if the job names one.
        skeleton_map: Role by joint name of the skeleton file.
        tpose_frame: Frame of the skeleton file that holds its T-pose; None for its zero pose.
        height_m: Stature, if the job states it.
        activity: What the subject does.
        mounts: One per camera.
    """

    skeleton: str | None
    skeleton_file: FileRef | None
    skeleton_map: Mapping[str, str]
    tpose_frame: int | None
    height_m: float | None
    activity: Activity
    mounts: tuple[MountInput, ...]


def paths_of(artefacts: Iterable[ArtefactRef]) -> list[Path]:
    """Return the folders of artefacts."""
    return [artefact.path for artefact in artefacts]
