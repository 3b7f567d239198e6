"""COLMAP's sparse model, read by pycolmap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodycap_batch.core.errors import StoreError
from bodycap_batch.formats.colmap import write_colmap_model
from bodycap_batch.model.geometry import Similarity, invert
from tests.scenes import small_map


def move() -> Similarity:
    rotation = Rotation.from_rotvec([0.3, -1.2, 0.4]).as_matrix()
    return Similarity(2.5, rotation, np.array([1.0, -2.0, 3.0]))


def test_pycolmap_reads_what_was_written(tmp_path: Path) -> None:
    import pycolmap

    scene = small_map()
    write_colmap_model(tmp_path, scene, move(), {"torso": np.arange(1000) + 100})
    model = pycolmap.Reconstruction(str(tmp_path))
    assert model.num_reg_images() == len(scene.keyframe_camera)
    assert model.num_points3D() == len(scene.points)
    assert model.compute_num_observations() == len(scene.obs_px)
    images = {image.name: image for image in model.images.values()}
    for keyframe, camera in enumerate(scene.keyframe_camera):
        frame = int(scene.keyframe_frame[keyframe]) + (100 if camera == "torso" else 0)
        image = images[f"{camera}/{frame:06d}.png"]
        world_from_cam = move().apply_to_poses(scene.map_from_cam[keyframe])
        np.testing.assert_allclose(image.cam_from_world().matrix(), invert(world_from_cam)[:3], atol=1e-12)
        lens = scene.cameras[camera]
        assert (image.camera.model.name, image.camera.width) == (lens.model, lens.width_px)
        np.testing.assert_array_equal(image.camera.params, lens.params)


def test_observations_still_reproject(tmp_path: Path) -> None:
    """A similarity moves points and cameras together, so every residual is unchanged up to rounding."""
    import pycolmap

    scene = small_map()
    write_colmap_model(tmp_path, scene, move())
    model = pycolmap.Reconstruction(str(tmp_path))
    seen = 0
    for image in model.images.values():
        for point2d in image.points2D:
            point = model.points3D[point2d.point3D_id]
            assert np.abs(image.project_point(point.xyz) - point2d.xy).max() < 1e-8
            assert any(e.image_id == image.image_id for e in point.track.elements)
            seen += 1
    assert seen == len(scene.obs_px)
    for index, point in model.points3D.items():
        np.testing.assert_array_equal(point.color, scene.colors[index - 1])
        assert point.track.length() == int((scene.obs_point == index - 1).sum())


def test_a_model_that_cannot_be_written_is_an_error_of_the_disk(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(StoreError):
        write_colmap_model(tmp_path / "file" / "0", small_map())
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
