"""The clocks of cameras from generated paths of a trunk and its limbs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from bodycap_batch.clocks.motion_offsets import motion_clocks
from bodycap_batch.clocks.motion_signals import CameraPath, motion_signals
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.camera_clock import ClockRelation
from bodycap_batch.model.geometry import interpolate_pose, make_transform, so3_exp

RATE_HZ = 60.0
ROLES = {"torso": "Spine1", "left_palm": "LeftHand", "right_palm": "RightHand"}


@dataclass
class Body:
    """A trunk that walks and turns, and hands that swing: poses at 60 Hz from time 0."""

    poses: dict[str, FloatArray]

    def path(
        self,
        camera: str,
        start_s: float,
        end_s: float,
        *,
        fps: float = 30.0,
        seed: int = 0,
        scale: float = 1.0,
        drift_ppm: float = 0.0,
    ) -> CameraPath:
        """Return what a camera measures that starts and ends at common times; its own clock starts at 0."""
        rng = np.random.default_rng([seed, len(camera)])
        own_s = np.arange(0.0, end_s - start_s, 1.0 / fps)
        at = np.clip((start_s + own_s * (1 + 1e-6 * drift_ppm)) * RATE_HZ, 0, len(self.poses[camera]) - 1.001)
        before = at.astype(np.int64)
        poses = interpolate_pose(self.poses[camera][before], self.poses[camera][before + 1], at - before)
        noise = make_transform(
            so3_exp(rng.normal(0, 0.002, (len(at), 3))), rng.normal(0, 0.002, (len(at), 3))
        )
        poses = poses @ noise
        poses[:, :3, 3] *= scale
        times_ns = np.round(own_s * 1e9).astype(np.int64)
        return CameraPath(camera=camera, role=ROLES[camera], times_ns=times_ns, map_from_cam=poses)


def smooth_noise(rng: np.random.Generator, count: int, sigma_s: float, size: float) -> FloatArray:
    """Return noise (count,3) that changes within about `sigma_s`, with RMS `size` on each axis."""
    noise = gaussian_filter1d(rng.standard_normal((count, 3)), sigma_s * RATE_HZ, axis=0, mode="wrap")
    return np.asarray(size * noise / noise.std(axis=0))


def make_body(seconds: float, seed: int = 0, *, kind: str = "free") -> Body:
    """Return a body: ``free`` walks about, ``straight`` repeats each step exactly, ``still`` stands."""
    rng = np.random.default_rng(seed)
    count = round(seconds * RATE_HZ) + 1
    time = np.arange(count) / RATE_HZ
    if kind == "still":
        trunk = np.tile(np.eye(4), (count, 1, 1))
    elif kind == "straight":
        step = 2 * np.pi * time / 1.1
        place = np.column_stack([1.2 * time, 0.03 * np.sin(step), 0.03 * np.cos(2 * step)])
        turn = np.column_stack([0.05 * np.cos(step), 0.02 * np.sin(2 * step), 0.1 * np.sin(step)])
        trunk = make_transform(so3_exp(turn), place)
    else:
        place = smooth_noise(rng, count, 1.0, 0.7) + smooth_noise(rng, count, 0.12, 0.015)
        turn = smooth_noise(rng, count, 0.8, 0.5) + smooth_noise(rng, count, 0.12, 0.04)
        trunk = make_transform(so3_exp(turn), place)
    poses = {"torso": trunk}
    for side, name in ((1, "left_palm"), (-1, "right_palm")):
        if kind == "straight":
            swing = 0.5 * np.sin(2 * np.pi * time / 1.1 + (0 if side > 0 else np.pi))
            turn = np.column_stack([np.zeros(count), swing, np.zeros(count)])
            place = np.column_stack([0.5 * np.sin(swing), np.full(count, 0.25 * side), -0.5 * np.cos(swing)])
        else:
            turn = smooth_noise(rng, count, 0.25, 0.3)
            place = np.array([0.2, 0.25 * side, -0.4]) + smooth_noise(rng, count, 0.3, 0.06)
        poses[name] = trunk @ make_transform(so3_exp(turn), place)
    return Body(poses)


def offset_of(first: CameraPath, second: CameraPath) -> ClockRelation:
    """Return the clock of the second camera relative to the first one."""
    found = motion_clocks([first, second], first.camera)
    assert second.camera in found.clocks, found.reasons
    return found.clocks[second.camera]


def refusal(first: CameraPath, second: CameraPath) -> str:
    """Return why the second camera has no clock; empty if it has one."""
    found = motion_clocks([first, second], first.camera)
    return "" if second.camera in found.clocks else found.reasons[second.camera]


@pytest.mark.parametrize("scale", [0.1, 20.0])
def test_offset_is_found_and_the_scale_does_not_matter(scale: float) -> None:
    body = make_body(14.0)
    found = offset_of(
        body.path("torso", 0.0, 12.0, scale=scale), body.path("left_palm", 1.37, 14.0, scale=scale)
    )
    # Five of its own standard deviations would show an error of sign, frame or interpolation.
    assert abs(found.offset_s - 1.37) < min(5 * found.sigma_s, 0.06)
    assert 0.005 < found.sigma_s < 0.05


def test_exchanged_cameras_give_the_negative_offset() -> None:
    body = make_body(12.0, seed=3)
    one, two = body.path("torso", 0.0, 10.0), body.path("right_palm", 0.81, 12.0)
    forth, back = offset_of(one, two), offset_of(two, one)
    assert forth.offset_s == pytest.approx(-back.offset_s, abs=0.002)


def test_straight_periodic_walk_is_not_off_by_a_step() -> None:
    body = make_body(14.0, kind="straight")
    paths = body.path("torso", 0.0, 11.0), body.path("left_palm", 1.5, 14.0)
    # The walk repeats after 1.1 s. It is either right or refused.
    assert refusal(*paths) or abs(offset_of(*paths).offset_s - 1.5) < 0.15


def test_standing_still_is_unknown() -> None:
    body = make_body(14.0, kind="still")
    assert refusal(body.path("torso", 0.0, 12.0), body.path("left_palm", 1.0, 14.0))


def test_paths_of_different_takes_are_refused() -> None:
    for seed in range(6):
        one, two = make_body(12.0, seed=seed), make_body(12.0, seed=100 + seed)
        assert refusal(one.path("torso", 0.0, 12.0), two.path("left_palm", 0.0, 12.0))


def test_paths_that_share_no_moment_are_refused() -> None:
    for seed in range(6):
        body = make_body(25.0, seed=seed)
        assert refusal(body.path("torso", 0.0, 12.0), body.path("left_palm", 13.0, 25.0))


def test_recordings_that_overlap_only_in_part() -> None:
    body = make_body(30.0, seed=5)
    found = offset_of(body.path("torso", 0.0, 18.0), body.path("left_palm", 10.0, 30.0))
    assert abs(found.offset_s - 10.0) < 0.06


def test_recordings_that_start_minutes_apart_and_drift() -> None:
    body = make_body(270.0, seed=6)
    torso = body.path("torso", 0.0, 260.0, fps=20.0)
    palm = body.path("left_palm", 130.0, 269.0, fps=20.0, drift_ppm=80.0)
    found = offset_of(torso, palm)
    # At the middle of the palm's recording, where the drift hardly matters.
    assert abs(found.offset_s + 1e-6 * found.drift_ppm * 65.0 - 130.0 - 80e-6 * 65.0) < 0.05
    assert abs(found.drift_ppm - 80.0) < 3 * found.drift_sigma_ppm < 150.0


def test_gaps_and_variable_frame_rate() -> None:
    body = make_body(16.0, seed=7)
    rng = np.random.default_rng(1)

    def broken(path: CameraPath) -> CameraPath:
        time = path.times_ns * 1e-9
        keep = ~((time > 3.0) & (time < 4.2)) & ~((time > 7.0) & (time < 7.6))
        keep &= rng.uniform(size=len(time)) > 0.3
        return CameraPath(
            camera=path.camera,
            role=path.role,
            times_ns=path.times_ns[keep],
            map_from_cam=path.map_from_cam[keep],
        )

    found = offset_of(
        broken(body.path("torso", 0.0, 14.0, fps=30.0)), broken(body.path("left_palm", 0.9, 16.0, fps=47.0))
    )
    assert abs(found.offset_s - 0.9) < 0.06


def test_gross_errors_of_poses_do_not_change_the_offset() -> None:
    body = make_body(14.0, seed=8)
    clean = body.path("left_palm", 0.7, 14.0)
    poses = clean.map_from_cam.copy()
    poses[[50, 51, 120, 200, 201, 202], :3, 3] += 3.0
    rough = CameraPath(camera="left_palm", role="LeftHand", times_ns=clean.times_ns, map_from_cam=poses)
    torso = body.path("torso", 0.0, 13.0)
    expected, found = offset_of(torso, clean), offset_of(torso, rough)
    assert found.offset_s == pytest.approx(expected.offset_s, abs=0.01)


def test_limb_that_does_not_move_relative_to_the_trunk() -> None:
    body = make_body(12.0, seed=9)
    body.poses["left_palm"] = body.poses["torso"] @ make_transform(np.eye(3), [0.2, 0.2, -0.3])
    found = offset_of(body.path("torso", 0.0, 11.0), body.path("left_palm", 0.456, 12.0))
    # A rigid body has no lag; what remains is the noise of the poses, 2 mm.
    assert abs(found.offset_s - 0.456) < 0.01


def test_too_few_frames_and_too_little_common_time_are_named() -> None:
    body = make_body(14.0)
    short = body.path("left_palm", 1.0, 1.4)
    assert "left_palm" in refusal(body.path("torso", 0.0, 12.0), short)
    assert "for 2 s" in refusal(body.path("torso", 0.0, 1.5), body.path("left_palm", 0.0, 14.0))


def test_all_clocks_are_solved_together() -> None:
    body = make_body(20.0, seed=11)
    starts = {"torso": 2.0, "left_palm": 0.6, "right_palm": 3.1}
    paths = [body.path(name, start, start + 15.0) for name, start in starts.items()]
    solved = motion_clocks(paths, "torso")
    assert not solved.reasons
    for name, start in starts.items():
        clock = solved.clocks[name]
        assert abs(clock.offset_s - (start - 2.0)) < max(4 * clock.sigma_s, 1e-9)


def test_camera_of_another_take_stays_unknown_with_a_reason() -> None:
    body, other = make_body(20.0, seed=12), make_body(20.0, seed=212)
    paths = [body.path("torso", 0.0, 15.0), body.path("left_palm", 1.0, 16.0)]
    solved = motion_clocks([*paths, other.path("right_palm", 0.0, 15.0)], "torso")
    assert set(solved.clocks) == {"torso", "left_palm"}
    assert solved.reasons["right_palm"]


def test_signals_are_missing_in_gaps() -> None:
    path = make_body(6.0).path("torso", 0.0, 6.0)
    keep = (path.times_ns < 2e9) | (path.times_ns > 3e9)
    signals = motion_signals(
        CameraPath(
            camera="torso", role="Spine1", times_ns=path.times_ns[keep], map_from_cam=path.map_from_cam[keep]
        )
    )
    assert signals is not None
    assert signals.present_s == pytest.approx(5.0, abs=0.3)
