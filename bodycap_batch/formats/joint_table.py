"""Read ``joints.csv`` or ``joints.npz``: the pose of every joint at every tick of the motion."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path

import numpy as np

from bodycap_batch.core.arrays import BoolArray, FloatArray, IntArray, set_array
from bodycap_batch.core.errors import JobError
from bodycap_batch.core.text_encoding import encoding_of_file
from bodycap_batch.model.geometry import rotation_from_quat_xyzw

COLUMNS = "time,joint,x_m,y_m,z_m,qx,qy,qz,qw,local_qx,local_qy,local_qz,local_qw,observed,sigma_m"
_NUMBERS = ("time", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "observed", "sigma_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class BodyMotion:
    """The solved motion of the body: J joints at T ticks of the common clock, in the world.

    The world has metres, Z up and the floor at z = 0.

    Attributes:
        joints: (J,) name of each joint.
        times_ns: (T,) time of each tick on the common clock, nanoseconds.
        positions_m: (T,J,3) centre of each joint, metres.
        rotations: (T,J,3,3) orientation of each joint, world_from_joint.
        observed: (T,J) True if cameras measured the joint at this tick. The motion of other joints is
            plausible, but not measured.
        sigma_m: (T,J) standard deviation per axis of each centre relative to the first solved joint, metres;
            NaN if it is unknown.
    """

    joints: tuple[str, ...]
    times_ns: IntArray
    positions_m: FloatArray
    rotations: FloatArray
    observed: BoolArray
    sigma_m: FloatArray

    def __post_init__(self) -> None:
        shape = (len(self.times_ns), len(self.joints))
        set_array(self, "times_ns", (None,), np.int64)
        set_array(self, "positions_m", (*shape, 3))
        set_array(self, "rotations", (*shape, 3, 3))
        set_array(self, "observed", shape, np.bool_)
        set_array(self, "sigma_m", shape, finite=False)

    @property
    def times_s(self) -> FloatArray:
        """Time (T,) of each tick on the common clock, seconds."""
        return np.asarray(self.times_ns * 1e-9)

    def index(self, joint: str) -> int:
        """Return the index of a joint by its name.

        Raises:
            JobError: There is no joint of this name.
        """
        if joint not in self.joints:
            raise JobError(f"there is no joint {joint!r}", hint=f"the joints are: {', '.join(self.joints)}")
        return self.joints.index(joint)


def read_joint_table(path: Path) -> BodyMotion:
    """Read the motion of the joints from a file ``joints.csv`` or ``joints.npz`` of a job.

    Raises:
        JobError: The file is missing or malformed.
    """
    try:
        return _from_arrays(path) if path.suffix == ".npz" else _from_csv(path)
    except (OSError, KeyError, ValueError, IndexError) as error:
        raise JobError(
            f"the table of the joints cannot be read: {error}", path=path, hint="run the job again"
        ) from error


def _from_csv(path: Path) -> BodyMotion:
    encoding = encoding_of_file(path)
    with path.open(newline="", encoding=encoding) as stream:
        rows = csv.DictReader(stream)
        first: dict[str, str] = next(rows, {})  # without a line, the time is missing
        tick = [first, *takewhile(lambda row: row["time"] == first["time"], rows)]
        wanted = [(rows.fieldnames or ()).index(name) for name in _NUMBERS]
    table = np.loadtxt(
        path,
        delimiter=",",
        skiprows=1,
        usecols=wanted,
        quotechar='"',
        comments=None,
        encoding=encoding,
        converters={wanted[-1]: lambda text: float(text or "nan")},
        ndmin=2,
    ).reshape(-1, len(tick), len(_NUMBERS))
    return BodyMotion(
        joints=tuple(row["joint"] for row in tick),
        times_ns=_nanoseconds(table[:, 0, 0]),
        positions_m=table[..., 1:4],
        rotations=rotation_from_quat_xyzw(table[..., 4:8]),
        observed=table[..., 8] == 1,
        sigma_m=table[..., 9],
    )


def _from_arrays(path: Path) -> BodyMotion:
    with np.load(path, allow_pickle=False) as content:
        return BodyMotion(
            joints=tuple(content["names"].tolist()),
            times_ns=_nanoseconds(content["t"]),
            positions_m=content["world"],
            rotations=rotation_from_quat_xyzw(content["world_quat_xyzw"]),
            observed=content["observed"],
            sigma_m=content["sigma_m"],
        )


def _nanoseconds(seconds: FloatArray) -> IntArray:
    return np.asarray(np.round(seconds * 1e9).astype(np.int64))
