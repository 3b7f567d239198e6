"""How upright the solved body of a person is who bends: ``python -m tests.bench upright``.

Simulated paths of cameras on a walker who bends forward at the hips for about half of the time, with noise
of 3 mm and 0.15°, and the samples of a consumer's sensor on each camera. The merge runs without and with the
sensors. Printed: the tilt of the world; the tilt of the chest against its true one (root mean square over
all ticks, and over those that are bent by more than 20°), which contains the constant error of the mount; the
same without a constant turn; and the tilt of the vertical that the sensor of each camera alone gives.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bodycap_batch.config.options import MergeOptions, TelemetryOptions
from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.context import StageContext
from bodycap_batch.inertial.camera_sensor import use_sensor
from bodycap_batch.model.gravity import fit_gravity
from bodycap_batch.model.merge_data import MergeInputs
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.synthetic.moving_body import MovingBody, camera_poses_at
from bodycap_batch.synthetic.options import SynthOptions
from tests.bench import posed
from tests.inertial import Sensor

CAMERAS = ("torso", "left_palm", "right_palm")
BENT_DEG = 20.0
UP = np.array([0.0, 0.0, 1.0])


class Bending:
    """A walker who bends forward every few seconds, and lowers the hips."""

    def __init__(self, walker: MovingBody, seed: int, seconds: float, most_deg: float) -> None:
        rng = np.random.default_rng(seed)
        self.skeleton: SkeletonModel = walker.skeleton
        self._walker = walker
        even_s = np.arange(2.5, seconds, 3.5)
        self._middle_s = even_s + rng.uniform(-0.5, 0.5, len(even_s))
        self._deg = np.column_stack(
            [rng.uniform(0.6, 1.0, len(even_s)) * most_deg, rng.uniform(-15.0, 15.0, len(even_s))]
        )

    def pose(self, t_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return root positions (T,3) and local rotations (T,J,3,3) at common times (T,)."""
        t_s = np.asarray(t_s, dtype=np.float64)
        root, local = (np.array(each) for each in self._walker.pose(t_s))
        rises = [np.clip((t_s[:, None] - self._middle_s - shift) / 0.7, 0.0, 1.0) for shift in (-1.2, 0.6)]
        weight = (rises[0] - rises[1]) ** 3 * (
            10.0 - 15.0 * (rises[0] - rises[1]) + 6.0 * (rises[0] - rises[1]) ** 2
        )
        turn = Rotation.from_euler("XY", weight @ self._deg, degrees=True).as_matrix()
        hips = self.skeleton.joints.index("Hips")
        local[:, hips] = local[:, hips] @ turn
        root[:, 2] -= 0.25 * weight.sum(axis=1)
        return root, local


@dataclass(frozen=True)
class _Carried:
    """A camera on a body."""

    body: MovingBody
    mount: Mount
    seconds: float

    def poses(self, times_s: FloatArray) -> FloatArray:
        return camera_poses_at(self.body, self.mount, np.clip(times_s, 0.0, self.seconds))


@dataclass(frozen=True)
class Uprightness:
    """Errors in degrees: of the world's vertical, and of the chest; of the bent ticks and without a turn."""

    world: float
    chest: float
    bent: float
    turned: float


def capture(seed: int, seconds: float, most_deg: float, t_pose_s: float = 0.0) -> posed.Posed:
    """Return the paths of the cameras of a person who bends."""
    options = SynthOptions(
        seconds=seconds, cameras=CAMERAS, seed=seed, poses_only=True, walk="gait", t_pose_s=t_pose_s,
        pose_sigma_m=0.003, pose_sigma_deg=0.15,
    )  # fmt: skip
    return posed.posed(options, move=lambda walker: Bending(walker, seed, seconds, most_deg))


def with_sensors(made: posed.Posed) -> MergeInputs:
    """Return the inputs of the merge with what the sensors measure."""
    seconds = made.options.seconds
    paths = {each.camera: each for each in made.inputs.trajectories}
    telemetry = {
        mount.camera: Sensor().samples(_Carried(made.motion, mount, seconds), seconds, seed=made.options.seed)
        for mount in made.mounts
    }
    used = {
        name: use_sensor(
            path, telemetry[name], TelemetryOptions(), [(paths[o], telemetry[o]) for o in paths if o != name]
        )
        for name, path in paths.items()
    }
    windows = {name: each.camera.windows for name, each in used.items() if each.camera.windows is not None}
    return replace(
        made.inputs, force_windows=windows, trajectories=tuple(each.trajectory for each in used.values())
    )


def uprightness(made: posed.Posed, inputs: MergeInputs) -> Uprightness:
    """Merge the paths, and return how upright world and chest are."""
    from bodycap_batch.merging import merge_trajectories  # gtsam takes a second to import

    with tempfile.TemporaryDirectory(prefix="bodycap-upright-") as folder:
        result = merge_trajectories(inputs, MergeOptions(), StageContext(work_dir=Path(folder)))
    true, found = made.world_from_joint(), result.motion.world_from_joint()
    count = min(len(true), len(found))
    chest = made.motion.skeleton.roles.index("Spine1")
    mine = found[:count, result.skeleton.roles.index("Spine1")]
    # The third row of world_from_joint is the vertical in the axes of the joint.
    true_up, own_up = true[:count, chest, 2, :3], mine[:, 2, :3]
    off = _angles_deg(own_up, true_up)
    turn, _ = Rotation.align_vectors(true_up, own_up)
    is_bent = _angles_deg(true[:count, chest, :3, 2], UP) > BENT_DEG
    world_up = result.world_from_map[posed.GAUGE].rotation @ made.gauges[posed.GAUGE].rotation @ UP
    return Uprightness(
        world=float(_angles_deg(world_up, UP)),
        chest=_rms(off),
        bent=_rms(off[is_bent]),
        turned=_rms(_angles_deg(turn.apply(own_up), true_up)),
    )


def _angles_deg(one: FloatArray, two: FloatArray) -> FloatArray:
    return np.asarray(np.degrees(np.arccos(np.clip((one * two).sum(axis=-1), -1.0, 1.0))))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def main(arguments: Sequence[str]) -> int:
    """Print the errors of each draw without and with sensors."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench upright", description=__doc__)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first-seed", type=int, default=501)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--bent-deg", type=float, default=60.0, help="largest angle of a bend")
    parser.add_argument("--t-pose-s", type=float, default=0.0)
    options = parser.parse_args(arguments)
    for seed in range(options.first_seed, options.first_seed + options.seeds):
        made = capture(seed, options.seconds, options.bent_deg, options.t_pose_s)
        sensed = with_sensors(made)
        up = made.gauges[posed.GAUGE].rotation @ UP
        alone = [
            f"{name} {_angles_deg(found.up, up):.2f}"
            for name, windows in sensed.force_windows.items()
            if (found := fit_gravity([windows])) is not None
        ]
        for name, inputs in (("without", made.inputs), ("with", sensed)):
            got = uprightness(made, inputs)
            sys.stdout.write(
                f"seed {seed} {name:7}: world {got.world:.2f}, chest {got.chest:.2f}, bent {got.bent:.2f}, "
                f"without a constant turn {got.turned:.2f} deg\n"
            )
        sys.stdout.write(f"seed {seed} verticals of single cameras off by: {', '.join(alone)} deg\n")
        sys.stdout.flush()
    return 0
