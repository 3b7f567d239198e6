"""A box room with textured walls, rendered by intersecting pixel rays with its six faces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from bodycap_batch.capture import Capture, open_capture
from bodycap_batch.config.job import load_job
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import make_transform, so3_exp
from tests.videos import write_video

HALF_M = np.array([3.0, 2.5, 1.4])
TEXTURE_PX = 768
LENS = {"model": "PINHOLE", "width": 320, "height": 240, "params": [210.0, 210.0, 160.0, 120.0]}


@dataclass(frozen=True)
class Room:
    """Six face textures (6,T,T)."""

    faces: np.ndarray

    @staticmethod
    @cache
    def make(seed: int = 0) -> Room:
        """Return a room with patterns of blobs at several scales, different on every face."""
        rng = np.random.default_rng(seed)
        faces = np.zeros((6, TEXTURE_PX, TEXTURE_PX), np.float32)
        for face, cells in product(faces, (7, 17, 41, 90)):
            noise = rng.random((cells, cells)).astype(np.float32)
            np.add(
                face,
                cv2.resize(noise, (TEXTURE_PX, TEXTURE_PX), interpolation=cv2.INTER_CUBIC) > 0.55,
                out=face,
            )
        return Room(np.stack([cv2.GaussianBlur(face, (0, 0), 1.2) for face in faces]) * 60 + 8)

    def view(self, camera: Camera, world_from_cam: np.ndarray) -> np.ndarray:
        """Return a grey image (H,W) uint8 from a pose inside the room."""
        shape = (camera.height_px, camera.width_px)
        rays = _rays(camera.model, camera.width_px, camera.height_px, tuple(camera.params.tolist()))
        ray = rays @ world_from_cam[:3, :3].T
        centre = world_from_cam[:3, 3]
        with np.errstate(divide="ignore"):
            distance = np.where(ray == 0, np.inf, (np.sign(ray) * HALF_M - centre) / ray)
        axis = np.argmin(distance, axis=1)
        hit = centre + ray * distance.min(axis=1, keepdims=True)
        at = ((hit / HALF_M + 1) * 0.5 * (TEXTURE_PX - 1)).astype(np.float32).T.reshape(3, *shape)
        image = np.zeros(shape, np.float32)
        for number, texture in enumerate(self.faces):
            across, down = at[[each for each in range(3) if each != number // 2]]
            is_seen = ((axis == number // 2) & ((ray[:, number // 2] > 0) == number % 2)).reshape(shape)
            if is_seen.any():
                image = np.where(is_seen, cv2.remap(texture, across, down, cv2.INTER_LINEAR), image)
        return np.clip(image, 0, 255).astype(np.uint8)


@cache
def _rays(model: str, width_px: int, height_px: int, params: tuple[float, ...]) -> np.ndarray:
    """Return the lines of sight (N,3) of all pixels, row by row; z is 1."""
    camera = Camera(model=model, width_px=width_px, height_px=height_px, params=np.array(params))
    column, row = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    return np.column_stack(
        [camera.unproject(np.column_stack([column.ravel(), row.ravel()])), np.ones(row.size)]
    )


def look(forward_yaw_rad: float, pitch_rad: float = 0.0) -> np.ndarray:
    """Return a rotation world_from_cam (3,3): forward at a yaw about Z from +X, upwards by the pitch."""
    level = np.column_stack([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    return so3_exp([0, 0, forward_yaw_rad]) @ so3_exp([0, -pitch_rad, 0]) @ level


def stroll(count: int) -> dict[str, np.ndarray]:
    """Return poses (N,4,4) of two body cameras at 30 Hz: the body walks and turns, the palm swings."""
    t = np.arange(count) / 30.0
    body = np.stack([-1.2 + 0.7 * t, 0.5 * np.sin(1.3 * t), 0.05 * np.sin(7 * t)], axis=1)
    palm = body + np.stack([0.25 * np.sin(4 * t), -0.3 + 0 * t, -0.35 + 0.1 * np.cos(4 * t)], axis=1)
    torso = [make_transform(look(0.5 * np.sin(t)), p) for t, p in zip(t, body, strict=True)]
    hand = [
        make_transform(look(-0.6 + 0.4 * np.sin(4 * t), 0.25 * np.cos(4 * t)), p)
        for t, p in zip(t, palm, strict=True)
    ]
    return {"torso": np.array(torso), "left_palm": np.array(hand)}


def write_capture(
    folder: Path,
    paths: Mapping[str, np.ndarray],
    black: Mapping[str, range] | None = None,
    seed: int = 0,
    fps: int = 30,
) -> Capture:
    """Render a capture into a folder and open it; frames in `black` are dark."""
    room = Room.make(seed)
    camera = Camera(model="PINHOLE", width_px=320, height_px=240, params=np.array(LENS["params"]))
    rng = np.random.default_rng(seed)
    for name, poses in paths.items():
        frames = []
        for index, pose in enumerate(poses):
            image = room.view(camera, pose).astype(np.float32)
            if black and index in black.get(name, range(0)):
                image[:] = 12.0
            frames.append(np.clip(image + rng.normal(0, 1.5, image.shape), 0, 255).astype(np.uint8))
        write_video(folder / f"{name}.mp4", frames, fps=fps)
    lens = str(LENS).replace("'", '"')
    (folder / "calib.json").write_text(lens.replace("}", ', "pixel_origin": "COLMAP"}'), encoding="utf-8")
    return open_capture(load_job(folder).capture)
