"""PLY files: points, colours and camera paths, read by Open3D and by an independent parser."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.open3d_loader import load_open3d
from bodycap_batch.formats.palette import camera_colours
from bodycap_batch.formats.ply import PointCloud, add_camera_paths, read_ply, write_ply


def cloud(count: int) -> PointCloud:
    rng = np.random.default_rng(3)
    return PointCloud(
        points=rng.normal(size=(count, 3)), colors=rng.integers(0, 256, size=(count, 3)).astype(np.uint8)
    )


def test_round_trip_and_an_independent_reading(tmp_path: Path) -> None:
    written = cloud(500)
    write_ply(tmp_path / "map.ply", written)
    back = read_ply(tmp_path / "map.ply")
    np.testing.assert_array_equal(back.points, written.points)
    np.testing.assert_array_equal(back.colors, written.colors)
    head, _, body = (tmp_path / "map.ply").read_bytes().partition(b"end_header\n")
    assert head.startswith(b"ply\nformat binary_little_endian 1.0\n")
    assert b"element vertex 500\n" in head
    record = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("rgb", "u1", 3)])
    table = np.frombuffer(body, dtype=record)
    np.testing.assert_array_equal(table["z"], written.points[:, 2])
    np.testing.assert_array_equal(table["rgb"], written.colors)


def test_paths_keep_every_vertex_and_leave_gaps_open() -> None:
    path = np.array([[0, 0, 0], [1, 0, 0], [np.nan] * 3, [5, 0, 0], [5, 0.05, 0]])
    both = add_camera_paths(cloud(10), {"b": path, "a": np.full((2, 3), np.nan)}, spacing=0.25)
    path = both.points[10:]
    np.testing.assert_allclose(path[:, 0], [0, 0.25, 0.5, 0.75, 1, 5, 5])
    assert (both.colors[10:] == camera_colours("ab")["b"]).all()


def test_a_missing_folder_is_created_and_a_forbidden_one_is_an_error(tmp_path: Path) -> None:
    write_ply(tmp_path / "new" / "map.ply", cloud(1))
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        write_ply(tmp_path / "file" / "map.ply", cloud(1))


def test_a_failing_writer_keeps_the_earlier_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "map.ply"
    path.write_text("earlier")
    monkeypatch.setattr(load_open3d().io, "write_point_cloud", lambda *_, **__: False)
    with pytest.raises(StoreError, match="could not write"):
        write_ply(path, cloud(5))
    monkeypatch.setattr(load_open3d().io, "write_point_cloud", lambda *_, **__: True)
    with pytest.raises(StoreError, match="differs"):
        write_ply(path, cloud(5))
    assert [p.name for p in tmp_path.iterdir()] == ["map.ply"]
    assert path.read_text() == "earlier"


@pytest.mark.slow
def test_open3d_loads_without_plotly_which_loads_on_use() -> None:
    code = """
import sys
from bodycap_batch.formats.open3d_loader import load_open3d
open3d = load_open3d()
assert "dash" not in sys.modules
cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector([[1.0, 2.0, 3.0]]))
print(open3d.visualization.get_plotly_fig([cloud]).data[0].z.tolist())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[3.0]"), done.stderr
