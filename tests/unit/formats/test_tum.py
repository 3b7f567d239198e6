"""TUM trajectories: exact writing, tolerant reading, and errors that name the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bodycap_batch.core.errors import JobError
from bodycap_batch.formats.tum import TimedPoses, read_tum, seconds_text, write_tum
from bodycap_batch.model.geometry import make_transform, rotation_angle_rad


def poses(count: int, seed: int, start_ns: int = 0) -> TimedPoses:
    rng = np.random.default_rng(seed)
    return TimedPoses(
        times_ns=start_ns + np.cumsum(rng.integers(1, 10**8, size=count)),
        world_from_cam=make_transform(
            Rotation.random(count, random_state=rng).as_matrix(), rng.normal(scale=10.0, size=(count, 3))
        ),
    )


@settings(max_examples=30, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), start_ns=st.integers(-(10**12), 2 * 10**18))
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, seed: int, start_ns: int) -> None:
    path = tmp_path_factory.mktemp("tum") / "a.tum"
    written = poses(20, seed, start_ns)
    write_tum(path, written, ["gauge: world"])
    back = read_tum(path)
    np.testing.assert_array_equal(back.times_ns, written.times_ns)
    # half a unit of the ninth decimal
    np.testing.assert_allclose(back.world_from_cam[:, :3, 3], written.world_from_cam[:, :3, 3], atol=5.1e-10)
    turned = np.swapaxes(back.world_from_cam[:, :3, :3], 1, 2) @ written.world_from_cam[:, :3, :3]
    # four quaternion components rounded at 5e-10, twice the half angle
    assert rotation_angle_rad(turned).max() < 4e-9


def test_the_header_names_the_columns(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", poses(1, 0), ["gauge: map"])
    lines = (tmp_path / "a.tum").read_text().splitlines()
    assert lines[:2] == ["# gauge: map", "# timestamp tx ty tz qx qy qz qw"]


def test_files_of_other_programs_are_read(tmp_path: Path) -> None:
    text = (
        "\ufefftimestamp,tx,ty,tz,qx,qy,qz,qw\r\n\r\n# comment\r\n% another\r\n"
        "1305031098.6758, 4 5 6, 0 0 2 0\r\n1305031098.6659,1,2,3,0,0,0,1\r\n"
        "1305031098.6659 9 9 9 0 0 0 1\r\n"
    )
    (tmp_path / "a.tum").write_text(text, encoding="utf-8", newline="")
    back = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(back.times_ns, [1305031098665900000, 1305031098675800000])
    np.testing.assert_allclose(back.world_from_cam[:, :3, 3], [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(back.world_from_cam[1, :3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-15)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1 2 3", "3 columns"),
        ("1 2 3 4 0 0 0 x", "not a number"),
        ("one 2 3 4 0 0 0 1", "not a number"),
        ("nan 2 3 4 0 0 0 1", "not a number"),
        ("1e30 2 3 4 0 0 0 1", "out of range"),
        ("1 nan 3 4 0 0 0 1", "NaN"),
        ("1 2 3 4 0 0 0 0", "quaternion is zero"),
    ],
)
def test_broken_rows_are_named(tmp_path: Path, row: str, message: str) -> None:
    path = tmp_path / "a.tum"
    path.write_text(f"# head\n0 0 0 0 0 0 0 1\n{row}\n")
    with pytest.raises(JobError, match=message) as caught:
        read_tum(path)
    assert (caught.value.path, caught.value.line) == (str(path), 3)


def test_missing_and_empty_files(tmp_path: Path) -> None:
    with pytest.raises(JobError, match="cannot be read"):
        read_tum(tmp_path / "none.tum")
    (tmp_path / "empty.tum").write_text("\n")
    with pytest.raises(JobError, match="no poses"):
        read_tum(tmp_path / "empty.tum")


def test_a_camera_that_was_never_localised(tmp_path: Path) -> None:
    write_tum(tmp_path / "a.tum", poses(0, 0), ["camera left_palm"])
    assert len(read_tum(tmp_path / "a.tum").times_ns) == 0


def test_seconds_text() -> None:
    assert seconds_text(1_305_031_098_665_900_001) == "1305031098.665900001"
    assert seconds_text(-1) == "-0.000000001"
