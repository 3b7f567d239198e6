"""The job, typed: what to read, what body wears it, and one options block per stage."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator, model_validator

from bodycap_batch.config.calibration import Calibration
from bodycap_batch.config.mounts import MOUNT_NAMES, mount_of, role_of_segment
from bodycap_batch.config.options import (
    ExportOptions,
    KeyframeOptions,
    MapOptions,
    MergeOptions,
    RegistrationOptions,
)

SKELETON_PRESETS = ("none", "upper_body")


class _Block(BaseModel):
    """Base of the job's blocks: frozen, unknown keys refused, no NaN, no silent conversions of text."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _as_list(value: object) -> object:
    """A single video stands for a list of one."""
    return [value] if isinstance(value, str | Path) else value


class MountPose(_Block):
    """Measured pose of a camera on its bone: x_in_joint = rotation · x_in_cam + translation."""

    translation_m: tuple[float, float, float]
    quat_xyzw: tuple[float, float, float, float]

    @field_validator("quat_xyzw")
    @classmethod
    def _unit(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        norm = float(sum(v * v for v in value)) ** 0.5
        if norm < 1e-9:
            raise ValueError("a quaternion of zero length is no rotation")
        return tuple(v / norm for v in value)


Matrix4 = tuple[
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
    tuple[float, float, float, float],
]


class CameraConfig(_Block):
    """One camera of the capture."""

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_\-]{0,63}$", description="names the camera's results")
    video: Annotated[tuple[Path, ...], BeforeValidator(_as_list)] = Field(
        min_length=1, description="video file, folder of chapters, or list of chapters"
    )
    mount: str | None = Field(None, description="where it sits on the body; default: what its name says")
    segment: str | None = Field(None, description="bone that carries it, where the mount's name does not say")
    joint_from_cam: MountPose | Matrix4 | None = Field(
        None, description="measured mount, 4x4 or translation + quaternion"
    )
    sigma_deg: float | None = Field(None, gt=0, le=180, description="uncertainty of the mount's rotation")
    sigma_m: float | None = Field(None, gt=0, le=10, description="uncertainty of the mount's position")
    calibration: Calibration | Literal["auto"] | Path | None = Field(
        None, description="inline block, path to a calib.json, or auto; default: the capture's"
    )
    fov_deg: float | None = Field(
        None, gt=10, lt=170, description="field of view along the long side, first guess of calibration: auto"
    )
    timestamps: Path | None = Field(None, description="sidecar with one time in seconds per frame")
    offset_s: float | None = Field(None, description="common time = camera time + offset_s")
    rolling_shutter_s: float | None = Field(None, ge=-1, le=1, description="read-out time, first row to last")

    @property
    def role(self) -> str | None:
        """Anatomical name of the bone that carries the camera (``LeftHand``), None where unknown."""
        if self.segment is not None:
            return role_of_segment(self.segment)
        found = mount_of(self.mount or self.name)
        return None if found is None else found[1]


class CaptureConfig(_Block):
    """The videos of one recording."""

    cameras: tuple[CameraConfig, ...] = Field(min_length=1)
    calibration: Calibration | Literal["auto"] | Path | None = Field(
        None, description="calibration of every camera that has none of its own"
    )
    start_s: float | None = Field(None, description="first moment used, common clock")
    end_s: float | None = Field(None, description="last moment used, common clock")
    work_px: int = Field(
        960, ge=160, le=8192, description="long side the frames are worked at; never enlarged"
    )
    synthetic: dict[str, Any] | None = Field(
        None, description="options of `bodycap synth`; the videos are rendered on first use"
    )


class Job(_Block):
    """Everything a run needs."""

    capture: CaptureConfig
    name: str = Field(
        "", pattern=r"^[A-Za-z0-9._\-]{0,100}$", description="names the results; default: the file's"
    )
    out: Path | None = Field(None, description="results' folder; default out/<name>")
    skeleton: str | None = Field(None, description="none, upper_body, or a BVH file")
    height_m: float | None = Field(None, gt=0.4, lt=2.6, description="the subject's height")
    activity: Literal["walk", "generic"] = Field("generic", description="what the subject does")
    keyframes: KeyframeOptions = KeyframeOptions()
    map: MapOptions = MapOptions()
    registration: RegistrationOptions = RegistrationOptions()
    merge: MergeOptions = MergeOptions()
    export: ExportOptions = ExportOptions()
