"""Render the frames of each camera with exposure, rolling shutter and noise."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import cv2
import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import Mount, SkeletonModel, forward_kinematics
from bodycap_batch.synthetic.atlas import Atlas, Bytes
from bodycap_batch.synthetic.lens import RayGrid
from bodycap_batch.synthetic.stabilisation import turn_of_pictures, turned_poses
from bodycap_batch.synthetic.triangle_renderer import SceneRenderer, Triangles, concatenate_triangles
from bodycap_batch.synthetic.wearer import Wearer

_BLUR_STEP_PX = 1.0
"""Maximum image motion (px) between two sub-frames of a frame. A frame with motion blur is the mean of
several sub-frames, which are rendered at different times during the exposure."""
_MAX_BLUR_STEPS = 24
"""Maximum number of sub-frames of a blurred frame. The limit reduces the rendering time."""
_USUAL_DISTANCE_M = 0.5
"""Assumed distance (metres) of near objects from the camera. With this distance, a shift of the camera is
converted into image motion. The image motion determines the number of sub-frames."""
_NOISE_SURPLUS = 1 << 21
"""Number of additional random values in the noise array that all frames share. The noise of each frame is a
section of the array that starts at a random index below this number."""
_SHUTTER_BANDS = 16
"""Maximum number of bands of rows in a rolling-shutter image. All rows of a band show the wearer's body in
the same pose."""


_EXPOSURE_DELAY_S = 0.5
"""Time constant (seconds) of the automatic exposure. Evidence: none."""
_MID_GREY = 118.0
"""Grey level that the automatic exposure makes of the mean. Origin: 18 % of the light, in sRGB."""


class MovingBody(Protocol):
    """A body that moves: its skeleton, and its pose at any time."""

    skeleton: SkeletonModel

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return root positions (T,3) in the world (m) and local rotations (T,J,3,3) at common times (T,)."""
        ...


def joint_poses_at(motion: MovingBody, t_s: FloatArray) -> FloatArray:
    """Return the poses world_from_joint (T,J,4,4) of all joints at common times (T,) in seconds."""
    return forward_kinematics(motion.skeleton, *motion.pose(np.asarray(t_s, dtype=np.float64)))


def camera_poses_at(motion: MovingBody, mount: Mount, t_s: FloatArray) -> FloatArray:
    """Return the poses world_from_cam (T,4,4) of a mounted camera at common times (T,) in seconds."""
    joint = motion.skeleton.index_of_role(mount.role)
    return np.asarray(joint_poses_at(motion, t_s)[:, joint] @ mount.joint_from_cam)


def picture_poses_at(motion: MovingBody, mount: Mount, t_s: FloatArray, *, stabilised: bool) -> FloatArray:
    """Return the poses world_from_picture (T,4,4) of a camera's pictures at common times (T,) in seconds.

    Pictures that are not stabilised have the pose of the camera.
    """
    poses = camera_poses_at(motion, mount, t_s)
    if not stabilised:
        return poses
    turns = turn_of_pictures(lambda times_s: camera_poses_at(motion, mount, times_s), t_s)
    return turned_poses(poses, turns)


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraRenderer:
    """Renderer of the frames of a camera on a moving body in a room.

    Attributes:
        motion: The moving body.
        mount: True mount of the camera.
        grid: Viewing rays of the camera's lens.
        room: Triangles of the room.
        atlas: Atlas of all textures.
        scene: Renderer of the room without the wearer.
        wearer: Surface of the body; None if the body is not rendered.
        exposure_s: Exposure time, seconds.
        rolling_shutter_s: Time (seconds) between the exposures of the first and the last row.
        stabilised: Whether the camera stabilises its pictures.
    """

    motion: MovingBody
    mount: Mount
    grid: RayGrid
    room: Triangles
    atlas: Atlas
    scene: SceneRenderer
    wearer: Wearer | None
    exposure_s: float
    rolling_shutter_s: float
    stabilised: bool = False

    def poses_at(self, t_s: FloatArray) -> FloatArray:
        """Return the poses world_from_picture (T,4,4) of pictures at common times (T,) in seconds."""
        return picture_poses_at(self.motion, self.mount, t_s, stabilised=self.stabilised)

    def render(self, t_s: float) -> Bytes:
        """Return the image (H,W,3) without noise. The exposure is centred on a common time (seconds)."""
        steps = self._blur_steps(t_s)
        shifts = self.exposure_s * ((np.arange(steps) + 0.5) / steps - 0.5)
        if steps == 1:
            return self._instant(t_s)
        total = np.zeros(self.grid.in_cam.shape, np.float32)
        for shift in shifts:
            cv2.accumulate(self._instant(t_s + float(shift)), total)
        return np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / steps))

    def _instant(self, t_s: float) -> Bytes:
        """Return the image (H,W,3) at a common time (seconds) without motion blur."""
        height = self.grid.in_cam.shape[0]
        if self.rolling_shutter_s == 0.0:
            pose = self.poses_at(np.array([t_s]))
            return self._scene_at(t_s).image(self.grid, pose[0], slice(0, height))
        rows_s = t_s + ((np.arange(height) + 0.5) / height - 0.5) * self.rolling_shutter_s
        poses = self.poses_at(rows_s)
        edges = np.linspace(0, height, min(_SHUTTER_BANDS, height) + 1).astype(int)
        bands = [slice(low, high) for low, high in pairwise(edges.tolist())]
        scenes = [self._scene_at(float(rows_s[band].mean())) for band in bands]
        parts = [scene.image(self.grid, poses[band], band) for scene, band in zip(scenes, bands, strict=True)]
        return np.concatenate(parts)

    def _scene_at(self, t_s: float) -> SceneRenderer:
        """Return a renderer of the room with the wearer's body at a common time (seconds)."""
        if self.wearer is None:
            return self.scene
        joints = joint_poses_at(self.motion, np.array([t_s]))[0]
        return SceneRenderer(concatenate_triangles(self.room, self.wearer.at(joints)), self.atlas)

    def _blur_steps(self, t_s: float) -> int:
        """Return the number of sub-frames that gives a motion blur without visible steps."""
        if self.exposure_s == 0.0:
            return 1
        half = self.exposure_s / 2
        start, end = self.poses_at(np.array([t_s - half, t_s + half]))
        px_per_rad = 1.0 / float(np.linalg.norm(self.grid.per_px_x, axis=-1).max())
        cosine = (np.trace(start[:3, :3].T @ end[:3, :3]) - 1) / 2
        shift_m = np.linalg.norm(end[:3, 3] - start[:3, 3])
        motion_rad = np.arccos(np.clip(cosine, -1, 1)) + 1.0 / _USUAL_DISTANCE_M * shift_m
        return int(np.clip(np.ceil(motion_rad * px_per_rad / _BLUR_STEP_PX), 2, _MAX_BLUR_STEPS))


class Sensor:
    """Sensor that converts ideal images into recorded images with white balance and noise, in 8 bits.

    Args:
        noise: Standard deviation (grey levels) of the noise at mid grey. Half of the variance at mid grey is
            read noise, which does not depend on the light; the other half is shot noise.
        size: Number of values of one image: height · width · 3.
        seed: Seed of white balance and noise.
    """

    def __init__(self, noise: float, size: int, seed: np.random.SeedSequence) -> None:
        self._seed, self._count = seed.generate_state(4).tolist(), size
        rng = np.random.default_rng(seed)
        gain = rng.uniform(0.94, 1.06, 3)
        self._mean = (np.arange(256)[:, None] * gain)[None].astype(np.float32)
        self._sigma = (noise * np.sqrt(0.5 + self._mean * (0.5 / 128.0))).astype(np.float32)
        # Drawing a million numbers for each frame would double the rendering time. So frames share one array.
        self._normal = rng.standard_normal(size + _NOISE_SURPLUS if noise > 0 else 0, dtype=np.float32)

    def record(self, image: Bytes, frame: int, gain: float = 1.0) -> Bytes:
        """Return an ideal image (H,W,3) as the sensor records it.

        The frame number determines the noise. The gain multiplies light and noise.
        """
        mean = cv2.LUT(image, self._mean)
        if gain != 1.0:
            mean = mean * np.float32(gain)
        if len(self._normal):
            start = int(np.random.default_rng([frame, *self._seed]).integers(0, _NOISE_SURPLUS))
            normal = self._normal[start : start + self._count].reshape(image.shape)
            noise = cv2.multiply(cv2.LUT(image, self._sigma), normal, scale=gain)
            return np.asarray(cv2.add(mean, noise, dtype=cv2.CV_8U))
        return np.asarray(cv2.convertScaleAbs(mean))


class AutoExposure:
    """Gain that follows the mean brightness of the images with a delay.

    Args:
        strength: 1: the mean brightness becomes mid grey; 0: the gain is always 1.
        interval_s: Time between two images, seconds.
    """

    def __init__(self, strength: float, interval_s: float) -> None:
        self._strength, self._share = strength, 1.0 - np.exp(-interval_s / _EXPOSURE_DELAY_S)
        self._log_gain: float | None = None

    def gain(self, image: Bytes) -> float:
        """Return the gain for the next ideal image (H,W,3)."""
        # The middle of the picture counts twice.
        height, width = image.shape[:2]
        middle = image[height // 4 : height - height // 4, width // 4 : width - width // 4]
        mean = (cv2.mean(image)[1] + cv2.mean(middle)[1]) / 2
        wanted = self._strength * float(np.log(_MID_GREY / max(mean, 8.0)))
        if self._log_gain is None:
            self._log_gain = wanted
        self._log_gain += self._share * (wanted - self._log_gain)
        return float(np.exp(self._log_gain))
