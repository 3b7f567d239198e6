"""A walk with planted feet: each ankle stands still in stance, and the knees bend forward."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray
from bodycap_batch.model.skeleton import Motion, rest_pose
from tests.bodies import reaching

SPEED_M_S, CYCLE_S, STANCE, LIFT_M = 0.8, 1.0, 0.62, 0.09
SIDES = ("Left", "Right")


def walking(ticks: int = 90, fps: float = 30.0) -> tuple[Motion, BoolArray]:
    """Return the motion, and (T,2) whether the left and the right foot stand."""
    motion = reaching(ticks, fps=fps)
    body = motion.skeleton
    rest = rest_pose(body)[:, :3, 3]
    time = np.arange(ticks) / fps
    local = motion.local_rotation.copy()
    local[:, 0] = np.eye(3)
    root = np.stack([0 * time, -SPEED_M_S * time, np.full(ticks, 0.94 * rest[0, 2])], axis=1)
    stands = np.zeros((ticks, 2), dtype=bool)
    for number, side in enumerate(SIDES):
        hip, knee, ankle = (body.roles.index(side + part) for part in ("UpLeg", "Leg", "Foot"))
        phase = time / CYCLE_S + 0.5 * number
        cycle, share = np.floor(phase), phase % 1.0
        stands[:, number] = share < STANCE
        swing = np.clip((share - STANCE) / (1.0 - STANCE), 0.0, 1.0)
        passed = cycle + swing**3 * (10 - 15 * swing + 6 * swing**2) - 0.5 * number + STANCE / 2
        foot = np.stack(
            [
                np.full(ticks, rest[ankle, 0]),
                -SPEED_M_S * CYCLE_S * passed,
                rest[ankle, 2] + LIFT_M * np.sin(np.pi * swing) ** 2,
            ],
            axis=1,
        )
        start = root + rest[hip] - rest[0]
        thigh, shin = _bend(start, foot, rest[hip, 2] - rest[knee, 2], rest[knee, 2] - rest[ankle, 2])
        local[:, hip] = thigh
        local[:, knee] = np.swapaxes(thigh, -1, -2) @ shin
        local[:, ankle] = np.swapaxes(shin, -1, -2)
    return replace(motion, root_in_world_m=root, local_rotation=local), stands


def _bend(start: FloatArray, end: FloatArray, upper: float, lower: float) -> tuple[FloatArray, FloatArray]:
    """Return the world rotations (T,3,3) of thigh and shin, whose bones point down at rest."""
    way = end - start
    reach = np.linalg.norm(way, axis=1)
    assert (reach < upper + lower).all()
    along = way / reach[:, None]
    front = np.array([0.0, -1.0, 0.0]) - (along @ [0.0, -1.0, 0.0])[:, None] * along
    front /= np.linalg.norm(front, axis=1, keepdims=True)
    cosine = (upper**2 + reach**2 - lower**2) / (2 * upper * reach)
    knee = start + upper * (cosine[:, None] * along + np.sqrt(1 - cosine**2)[:, None] * front)
    return _turn(knee - start, front), _turn(end - knee, front)


def _turn(line: FloatArray, front: FloatArray) -> FloatArray:
    up = -line / np.linalg.norm(line, axis=1, keepdims=True)
    back = -front + np.sum(front * up, axis=1, keepdims=True) * up
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    return np.stack([np.cross(back, up), back, up], axis=-1)
