"""Given intrinsics are checked against a map, and camera models are selected with it."""

import numpy as np
import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.mapping.intrinsics.intrinsics_check import (
    find_misfit_intrinsics,
    misfit_note,
    refine_principal_points,
    select_camera_models,
)
from bodycap_batch.mapping.reconstruction.bundle_adjustment import bundle_adjust
from bodycap_batch.mapping.reconstruction.mapper_options import make_mapper_options
from bodycap_batch.model.geometry import so3_exp


def _model(factor, noise_px=0.5):
    """Return a map of two cameras, built with `factor` times the true focal length, and mapper options."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, 12, 200
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = noise_px
    pycolmap.synthesize_noise(noise, model)
    for camera in model.cameras.values():
        params = np.array(camera.params)
        params[0] *= factor
        camera.params = params
    settings = make_mapper_options(MapOptions(), list(model.cameras), 1.0)
    if factor != 1.0:
        bundle_adjust(model, settings, list(model.cameras), 60)
    return model, settings


def _names(model):
    return {number: f"camera {number}" for number in model.cameras}


def test_right_intrinsics_are_no_misfit():
    model, settings = _model(1.0)
    assert find_misfit_intrinsics(model, settings, _names(model)) == {}


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_a_wrong_focal_length_is_found_and_measured(factor):
    model, settings = _model(factor)
    before = [np.array(camera.params) for camera in model.cameras.values()]
    found = find_misfit_intrinsics(model, settings, _names(model))
    assert set(found) == set(_names(model).values())
    # 200 points with half a pixel of noise in 24 pictures from all sides: well below a percent.
    assert all(value == pytest.approx(1.0 / factor, rel=0.02) for value in found.values())
    after = [np.array(camera.params) for camera in model.cameras.values()]
    assert all((first == second).all() for first, second in zip(before, after, strict=True))


def test_a_wrong_principal_point_is_found():
    model, settings = _wrong_model("SIMPLE_RADIAL", [1280, 512, 384, 0.0], [1280, 600, 330, 0.0])
    for camera in model.cameras.values():
        camera.params = [1280, 600, 330, 0.0]
    bundle_adjust(model, settings, list(model.cameras), 60)
    found = find_misfit_intrinsics(model, settings, _names(model))
    assert set(found) == set(_names(model).values())
    assert all(value == pytest.approx(1.0, abs=0.03) for value in found.values())


def test_only_calibrated_cameras_with_enough_keyframes_are_checked():
    model, settings = _model(0.85)
    assert find_misfit_intrinsics(model, settings, {}) == {}
    first = next(iter(model.cameras))
    assert set(find_misfit_intrinsics(model, settings, {first: "torso"})) == {"torso"}
    for image_id in sorted(model.reg_image_ids())[9:]:
        model.deregister_frame(model.image(image_id).frame_id)
    assert find_misfit_intrinsics(model, settings, _names(model)) == {}


def test_the_note_says_what_to_do():
    assert "12 % longer" in misfit_note("torso", 1.12)
    assert "12 % shorter" in misfit_note("torso", 0.88)
    assert "stabilisation" in misfit_note("torso", 0.88)
    assert "another image centre or another distortion than" in misfit_note("torso", 1.002, freed=True)


@pytest.mark.parametrize("factor", [0.95, 1.0, 1.006, 1.05])
def test_the_note_on_a_wrong_centre_does_not_name_the_focal_length(factor):
    note = misfit_note("torso", factor)
    assert "focal length" not in note
    assert "another image centre than" in note
    assert "cropped" in note


def test_a_camera_model_that_fits_is_kept():
    model, settings = _model(1.0)
    assert select_camera_models(model, settings, set(model.cameras)) == ({}, frozenset())
    assert select_camera_models(model, settings, set()) == ({}, frozenset())


def _wrong_model(model_name, params, wrong):
    """Return a map of cameras of a model, built with `wrong` SIMPLE_RADIAL parameters, and options."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, 12, 200
    options.camera_model_id, options.camera_params = getattr(pycolmap.CameraModelId, model_name), params
    model = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    pycolmap.synthesize_noise(noise, model)
    for camera in model.cameras.values():
        camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, wrong
    settings = make_mapper_options(MapOptions(), [], 1.0)
    bundle_adjust(model, settings, [], 60)
    return model, settings


def test_a_picture_cropped_off_its_centre_gets_its_principal_point():
    model, settings = _wrong_model("SIMPLE_RADIAL", [1280, 640, 300, 0.0], [1280, 512, 384, 0.0])
    found, decentred = select_camera_models(model, settings, set(model.cameras))
    assert set(found) == decentred == set(model.cameras)
    for camera in found.values():
        # It was 128 and 84 px off. The mapped points fitted the wrong centre and still hold it back a little.
        assert camera.model_name == "SIMPLE_RADIAL"
        assert camera.params == pytest.approx([1280, 640, 300, 0.0], abs=15.0)


def test_pixels_that_are_not_square_get_a_focal_length_for_each_axis():
    model, settings = _wrong_model("PINHOLE", [960, 1280, 512, 384], [1100, 512, 384, 0.0])
    found, decentred = select_camera_models(model, settings, set(model.cameras))
    assert set(found) == set(model.cameras)
    assert decentred == frozenset()
    for camera in found.values():
        assert camera.model_name == "OPENCV"
        assert camera.params[1] / camera.params[0] == pytest.approx(4 / 3, rel=0.01)


def test_square_pixels_keep_one_focal_length_even_if_two_lower_the_cost():
    # A decentred lens: the model with two focal lengths also has tangential distortion.
    lens = [1280, 1280, 512, 384, -0.05, 0.0, 0.01, -0.01]
    model, settings = _wrong_model("OPENCV", lens, [1280, 512, 384, 0.0])
    found, _ = select_camera_models(model, settings, set(model.cameras))
    assert "OPENCV" not in {camera.model_name for camera in found.values()}


def _fisheye_map(params):
    """Return a map of points on all sides, seen through a fisheye lens."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-4, -1.5, 2.5), (4, 1.5, 4), (500, 3))
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="OPENCV_FISHEYE", width=1024, height=768, params=params)
    model.add_camera_with_trivial_rig(camera)
    tracks = [pycolmap.Track() for _ in points]
    for number in range(1, 25):
        turn = so3_exp(rng.normal(0.0, (0.15, 0.4, 0.1)))
        shift = -turn @ rng.normal(0.0, (0.8, 0.2, 0.3))
        seen = camera.img_from_cam(points @ turn.T + shift)
        rows = np.flatnonzero(np.all((seen > 0) & (seen < (1024, 768)), axis=1))
        pixels = seen[rows] + rng.normal(0.0, 0.5, (len(rows), 2))
        image = pycolmap.Image(f"{number}", pixels, camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(turn), shift))
        for place, row in enumerate(rows):
            tracks[row].add_element(number, place)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track)
    return model


def test_a_fisheye_lens_with_square_pixels_gets_a_second_radial_term():
    model = _fisheye_map([400, 400, 512, 384, -0.1, 0.06, 0.0, 0.0])
    settings = make_mapper_options(MapOptions(), [], 1.0)
    model.camera(1).model, model.camera(1).params = pycolmap.CameraModelId.SIMPLE_RADIAL, [440, 512, 384, 0]
    bundle_adjust(model, settings, [], 60)
    found, decentred = select_camera_models(model, settings, set(model.cameras))
    assert set(found) == set(model.cameras)
    assert decentred == frozenset()
    for camera in found.values():
        assert camera.model_name == "RADIAL_FISHEYE"
        assert camera.params == pytest.approx([400, 512, 384, -0.1, 0.06], rel=0.01, abs=0.01)


def test_few_keypoints_do_not_decide_on_the_pixel_aspect():
    model, settings = _wrong_model("PINHOLE", [960, 1280, 512, 384], [1100, 512, 384, 0.0])
    first, second = sorted(model.cameras)
    mine = [number for number in sorted(model.reg_image_ids()) if model.image(number).camera_id == second]
    for number in mine[1:]:
        model.deregister_frame(model.image(number).frame_id)
    image = model.image(mine[0])
    seen = [row for row, point in enumerate(image.points2D) if point.has_point3D()]
    for row in seen[8 * 10 - 1 :]:
        model.delete_observation(mine[0], row)
    found, _ = select_camera_models(model, settings, {first, second})
    assert {number: camera.model_name for number, camera in found.items()} == {first: "OPENCV"}


def test_a_calibrated_camera_stays_constant_while_another_is_selected():
    model, _ = _wrong_model("SIMPLE_RADIAL", [1280, 512, 384, 0.0], [1280, 512, 384, 0.0])
    guessed, given = sorted(model.cameras)
    settings = make_mapper_options(MapOptions(), [given], 1.0)
    model.camera(given).params = [1280, 640, 300, 0.0]
    bundle_adjust(model, settings, [given], 60)
    # The estimate is right and the calibration is wrong: no change of the estimate explains the pictures.
    assert select_camera_models(model, settings, {guessed}) == ({}, frozenset())
    assert set(select_camera_models(model, settings, {guessed, given})[0]) == {guessed, given}


def test_a_principal_point_is_refined_again_in_a_better_map():
    model, settings = _wrong_model("SIMPLE_RADIAL", [1280, 640, 300, 0.0], [1280, 600, 330, 0.0])
    found = refine_principal_points(model, settings, set(model.cameras))
    assert set(found) == set(model.cameras)
    assert all(camera.params[1:3] == pytest.approx([640, 300], abs=5.0) for camera in found.values())
    right, settings = _wrong_model("SIMPLE_RADIAL", [1280, 640, 300, 0.0], [1280, 640, 300, 0.0])
    assert refine_principal_points(right, settings, set(right.cameras)) == {}
    assert refine_principal_points(model, settings, set()) == {}
