"""How much of the recording is delivered: the share of the frames and seconds, per camera and of the body."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bodycap_batch.core.percent import format_percent
from bodycap_batch.report.grades import Advice
from bodycap_batch.report.loss_causes import LostSpan, advice_about_losses
from bodycap_batch.report.readings import (
    Metrics,
    cameras_in_own_maps,
    clock_notes,
    diagnostics,
    main_cameras,
    unknown_clocks,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraCoverage:
    """How much of one camera's video has a pose in the main frame of the results.

    Attributes:
        frames: Number of frames of the video.
        delivered: Number of frames with a pose from their own picture.
        other_maps: Number of further frames with a pose in another map than that of the camera's path.
        rotation_only: Number of further frames with a rotation and no position.
        seconds: Duration of the video; None if the metrics do not state it.
        reason: Why the camera, or a part of its video, is left out; "" if it is not.
        lost: The lost spans; empty if they were not looked at.
    """

    frames: int
    delivered: int
    other_maps: int
    rotation_only: int
    seconds: float | None
    reason: str
    lost: tuple[LostSpan, ...]

    @property
    def share(self) -> float:
        """Share of the frames that are delivered."""
        return self.delivered / self.frames if self.frames else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the coverage as plain JSON values."""
        return {
            **_amounts(self.frames, self.delivered, self.seconds),
            "frames_in_other_maps": self.other_maps,
            "frames_rotation_only": self.rotation_only,
            "reason": self.reason,
            "lost": [span.to_dict() for span in self.lost],
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyCoverage:
    """How much of the motion was measured, of the joints that have cameras.

    Attributes:
        seconds: Duration of the motion.
        joints: Share of the time in which each of these joints was measured, by joint name.
        longest_gap_s: Longest time without a measurement of one camera; None if the metrics do not state it.
    """

    seconds: float
    joints: Mapping[str, float]
    longest_gap_s: float | None

    @property
    def share(self) -> float:
        """Mean share of the time over the joints."""
        return sum(self.joints.values()) / len(self.joints) if self.joints else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the coverage as plain JSON values."""
        return {
            "share": round(self.share, 4),
            "seconds": round(self.seconds, 3),
            "seconds_delivered": round(self.share * self.seconds, 3),
            "longest_gap_s": self.longest_gap_s,
            "joints": {name: round(share, 4) for name, share in self.joints.items()},
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Coverage:
    """How much of the recording is delivered.

    Attributes:
        cameras: Coverage of each camera, by camera name.
        body: Coverage of the body; None without a body.
        advice: What to change to have more delivered.
    """

    cameras: Mapping[str, CameraCoverage]
    body: BodyCoverage | None
    advice: tuple[Advice, ...]

    @property
    def frames(self) -> int:
        """Number of frames of all cameras."""
        return sum(camera.frames for camera in self.cameras.values())

    @property
    def delivered(self) -> int:
        """Number of frames of all cameras that are delivered."""
        return sum(camera.delivered for camera in self.cameras.values())

    @property
    def other_maps(self) -> int:
        """Number of further frames of all cameras with a pose in another map than that of the path."""
        return sum(camera.other_maps for camera in self.cameras.values())

    @property
    def rotation_only(self) -> int:
        """Number of further frames of all cameras with a rotation and no position."""
        return sum(camera.rotation_only for camera in self.cameras.values())

    @property
    def share(self) -> float:
        """Share of the frames of all cameras that are delivered."""
        return self.delivered / self.frames if self.frames else 0.0

    @property
    def text(self) -> str:
        """The coverage in words: the share of the frames, and the camera with the smallest share."""
        every = f"{format_percent(self.share, 1)} of the frames"
        if self.rotation_only:
            alone = f"the rotation alone of {format_percent(self.rotation_only / self.frames, 1)}"
            every = f"{every}, and {alone}" if self.share else f"{alone} of the frames"
        if self.share == 1.0 or len(self.cameras) < 2:
            return every
        worst = min(self.cameras, key=lambda name: self.cameras[name].share)
        return f"{every}; {worst} {format_percent(self.cameras[worst].share, 1)}"

    def to_dict(self) -> dict[str, Any]:
        """Return the coverage as plain JSON values, as in ``verdict.json``."""
        known = [camera.seconds for camera in self.cameras.values() if camera.seconds is not None]
        seconds = sum(known) if known and len(known) == len(self.cameras) else None
        return {
            **_amounts(self.frames, self.delivered, seconds),
            "frames_in_other_maps": self.other_maps,
            "frames_rotation_only": self.rotation_only,
            "cameras": {name: camera.to_dict() for name, camera in self.cameras.items()},
            "body": None if self.body is None else self.body.to_dict(),
            "advice": [each.to_dict() for each in self.advice],
        }


def _amounts(frames: int, delivered: int, seconds: float | None) -> dict[str, Any]:
    share = delivered / frames if frames else 0.0
    return {
        "share": round(share, 4),
        "frames": frames,
        "frames_delivered": delivered,
        "seconds": None if seconds is None else round(seconds, 3),
        "seconds_delivered": None if seconds is None else round(share * seconds, 3),
    }


def measure_coverage(metrics: Metrics, lost: Sequence[LostSpan] = ()) -> Coverage:
    """Return how much of the recording is delivered.

    Args:
        metrics: The content of ``metrics.json``.
        lost: The lost spans of all cameras; empty if the pictures were not looked at.
    """
    inside, reasons = main_cameras(metrics), _reasons(metrics)
    cameras = {
        name: CameraCoverage(
            frames=int(camera["frames"]),
            delivered=int(camera["frames_registered"]) if name in inside else 0,
            other_maps=int(camera.get("frames_in_other_maps", 0)),
            rotation_only=int(camera.get("frames_rotation_only", 0)),
            seconds=camera.get("seconds"),
            reason=reasons.get(name, ""),
            lost=tuple(span for span in lost if span.camera == name),
        )
        for name, camera in metrics["cameras"].items()
    }
    frames = sum(camera.frames for camera in cameras.values())
    usable = [span for span in lost if span.camera not in diagnostics(metrics).flipped_cameras]
    advice = (*_advice_about_cameras(metrics), *advice_about_losses(usable, frames))
    return Coverage(cameras=cameras, body=_body(metrics), advice=advice)


def _body(metrics: Metrics) -> BodyCoverage | None:
    motion = metrics.get("motion")
    if "merge" not in metrics or not motion or "fps" not in motion:
        return None
    gaps = [float(each["longest_gap_s"]) for each in metrics["merge"].get("cameras", {}).values()]
    joints = motion["joints"].items()
    return BodyCoverage(
        seconds=motion["frames"] / motion["fps"],
        joints={name: float(each["observed_share"]) for name, each in joints if each["observed"]},
        longest_gap_s=max(gaps, default=None),
    )


def _reasons(metrics: Metrics) -> dict[str, str]:
    """Return why a camera, or a part of its video, is left out, by camera name."""
    merge, found = metrics.get("merge", {}), diagnostics(metrics)
    reasons: dict[str, str] = {
        name: f"it stands still in the room between {float(part['from_s']):.1f} s and "
        f"{float(part['to_s']):.1f} s while the person moves: it fell off or was put down, and this part is "
        "not used"
        for name, part in merge.get("still_cameras", {}).items()
    }
    reasons |= dict.fromkeys(cameras_in_own_maps(metrics), "its map has no place in common with the main map")
    reasons |= {
        name: "only its rotation is known, because it hardly moves"
        if each.get("frames_rotation_only")
        else "no frame has a pose"
        for name, each in metrics["cameras"].items()
        if not each["frames_registered"]
    }
    reasons |= {name: str(reason) for name, reason in merge.get("unused_cameras", {}).items()}
    for name in unknown_clocks(metrics):
        reasons[name] = clock_notes(metrics, [name]).removeprefix(f"{name}: ") or "its clock is unknown"
    for name in found.flipped_cameras:
        reasons[name] = "left and right are exchanged in its video"
    return reasons


def _advice_about_cameras(metrics: Metrics) -> Iterator[Advice]:
    """Yield the advice about cameras that are left out, and about parts in which a camera was not worn."""
    found, flip = diagnostics(metrics), "`ffmpeg -i in.mp4 -vf hflip out.mp4` flips a video."
    if found.flipped_cameras:
        yield Advice(
            action=f"Flip the video of {', '.join(found.flipped_cameras)} back, and switch off the "
            "mirroring in the front camera or the app.",
            how=flip,
            reason="compared with the other cameras, left and right are exchanged in this video, and a "
            "mirrored video is not used in the map",
            priority=3.0,
        )
    for one, other in found.undecided_groups:
        yield Advice(
            action=f"Check whether text reads backwards in the video of {', '.join(one)} or "
            f"{', '.join(other)}. If text reads backwards, flip that video back. If text reads correctly in "
            "all of these videos, cover wall mirrors.",
            how=flip,
            reason="these cameras see mirror images of each other; it is unknown which video is mirrored",
            priority=3.0,
        )
    if still := metrics.get("merge", {}).get("still_cameras"):
        names = " and ".join(sorted(still))
        yield Advice(
            action=f"Fasten {names} so that it stays on the body until the end.",
            reason=f"{names} stood still in the room for some time while the person moved",
            priority=2.7,
        )
    unknown, own_maps = unknown_clocks(metrics), cameras_in_own_maps(metrics)
    if elsewhere := [name for name in unknown if name in own_maps]:
        yield Advice(
            action=f"Check that the video of {' and '.join(elsewhere)} is of this recording, and let all "
            "cameras see the same places. Clap once while they record with sound.",
            reason=clock_notes(metrics, elsewhere),
            priority=2.95,
        )
    if here := [name for name in unknown if name not in own_maps]:
        yield Advice(
            action="Clap once, or hop once, while all cameras record with sound.",
            how="For this recording, read the time of an event in two videos and state `offset_s` of the "
            "camera in the job file: the time in the video of the reference camera minus the time in the "
            "camera's own video.",
            reason=clock_notes(metrics, here),
            priority=2.9,
        )
