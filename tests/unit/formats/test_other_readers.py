"""BVH, C3D and TRC files, read by other libraries."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.export.layout import apply_layout
from bodycap_batch.export.motion_files import points_from_motion
from bodycap_batch.formats.bvh import write_bvh
from bodycap_batch.formats.c3d import write_c3d
from bodycap_batch.formats.trc import write_trc
from bodycap_batch.model.skeleton import Motion
from tests.bodies import reaching

# Six decimals of a degree on a chain of seven bones of 2 m in all; bvhio and c3d compute in single precision.
TOLERANCE_CM = 2e-4


def file_axes_cm(motion: Motion) -> np.ndarray:
    """Return the joint centres (T,J,3) in the axes and units of a BVH file: Y up, facing +Z, centimetres."""
    world = motion.world_from_joint()[..., :3, 3]
    return 100.0 * np.stack([world[..., 0], world[..., 2], -world[..., 1]], axis=-1)


@pytest.mark.parametrize("names", ["hik", "mixamo", "biped"])
def test_pybvh_gives_the_same_joint_centres(tmp_path: Path, names: str) -> None:
    import pybvh

    motion = apply_layout(reaching(30), ExportOptions.model_validate({"names": names, "tpose": True}))
    write_bvh(tmp_path / "a.bvh", motion)
    other = pybvh.read_bvh_file(str(tmp_path / "a.bvh"))
    assert (other.frame_count, other.fps) == (31, pytest.approx(30.0))
    order = [list(other.joint_names).index(name) for name in motion.skeleton.joints]
    np.testing.assert_allclose(other.joint_positions()[:, order], file_axes_cm(motion), atol=TOLERANCE_CM)


@pytest.mark.parametrize("names", ["hik", "mixamo", "biped", "unreal"])
@pytest.mark.parametrize("root", ["hips", "ground"])
def test_bvhio_gives_the_same_joint_centres(tmp_path: Path, names: str, root: str) -> None:
    import bvhio

    motion = apply_layout(reaching(20), ExportOptions.model_validate({"names": names, "root": root}))
    write_bvh(tmp_path / "a.bvh", motion)
    assert bvhio.readAsBvh(str(tmp_path / "a.bvh")).FrameCount == 20
    tree = bvhio.readAsHierarchy(str(tmp_path / "a.bvh"))
    expected = file_axes_cm(motion)
    for tick in (0, 7, 19):
        tree.loadPose(tick)
        at = {joint.Name: np.array(list(joint.PositionWorld)) for joint, _, _ in tree.layout()}
        found = np.array([at[name] for name in motion.skeleton.joints])
        np.testing.assert_allclose(found, expected[tick], atol=TOLERANCE_CM)


@pytest.mark.filterwarnings("ignore:No analog data")
def test_c3d_reads_our_points(tmp_path: Path) -> None:
    import c3d

    motion = reaching(25)
    write_c3d(tmp_path / "a.c3d", points_from_motion(motion))
    with open(tmp_path / "a.c3d", "rb") as handle:
        reader = c3d.Reader(handle)
        assert [label.strip() for label in reader.point_labels] == list(motion.skeleton.joints)
        assert reader.point_rate == 30.0
        found = np.array([points[:, :3] for _, points, _ in reader.read_frames()])
    np.testing.assert_allclose(found, 1000.0 * motion.world_from_joint()[..., :3, 3], atol=1e-3)


def test_trc_reader_reads_our_points(tmp_path: Path) -> None:
    from trc import TRCData

    motion = reaching(25)
    write_trc(tmp_path / "a.trc", points_from_motion(motion))
    other = TRCData()
    other.load(str(tmp_path / "a.trc"))
    assert (other["NumFrames"], other["Units"], other["DataRate"]) == (25, "mm", 30.0)
    assert other["Markers"] == list(motion.skeleton.joints)
    found = np.array([other[name] for name in motion.skeleton.joints]).swapaxes(0, 1)
    world = 1000.0 * motion.world_from_joint()[..., :3, 3]
    expected = np.stack([-world[..., 1], world[..., 2], -world[..., 0]], axis=-1)
    # three decimals of a millimetre
    np.testing.assert_allclose(found, expected, atol=5.1e-4)
