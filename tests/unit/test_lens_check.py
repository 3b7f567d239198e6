"""A map tells when the given lens is not the one that filmed."""

import numpy as np
import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.mapping.lens import better_lenses, misfit_note, misfitting_lenses, recentred_lenses
from bodycap_batch.mapping.solve import adjust, mapper_options


def _model(factor, noise_px=0.5):
    """A map of two cameras built with a focal length `factor` times the true one."""
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
    settings = mapper_options(MapOptions(), list(model.cameras), 1.0)
    if factor != 1.0:
        adjust(model, settings, list(model.cameras), 60)
    return model, settings


def _names(model):
    return {number: f"camera {number}" for number in model.cameras}


def test_the_right_lens_raises_no_alarm():
    model, settings = _model(1.0)
    assert misfitting_lenses(model, settings, _names(model)) == {}


@pytest.mark.parametrize("factor", [0.85, 1.15])
def test_a_wrong_focal_length_is_found_and_measured(factor):
    model, settings = _model(factor)
    before = [np.array(camera.params) for camera in model.cameras.values()]
    found = misfitting_lenses(model, settings, _names(model))
    assert set(found) == set(_names(model).values())
    # 200 points at half a pixel, 24 pictures all around: well below a percent.
    assert all(value == pytest.approx(1.0 / factor, rel=0.02) for value in found.values())
    after = [np.array(camera.params) for camera in model.cameras.values()]
    assert all((first == second).all() for first, second in zip(before, after, strict=True))


def test_a_centre_that_was_given_wrongly_is_found():
    model, settings = _guessed("SIMPLE_RADIAL", [1280, 512, 384, 0.0], [1280, 600, 330, 0.0])
    for camera in model.cameras.values():
        camera.params = [1280, 600, 330, 0.0]
    adjust(model, settings, list(model.cameras), 60)
    found = misfitting_lenses(model, settings, _names(model))
    assert set(found) == set(_names(model).values())
    assert all(value == pytest.approx(1.0, abs=0.03) for value in found.values())


def test_only_given_lenses_are_judged_and_a_handful_of_pictures_is_not():
    model, settings = _model(0.85)
    assert misfitting_lenses(model, settings, {}) == {}
    first = next(iter(model.cameras))
    assert set(misfitting_lenses(model, settings, {first: "torso"})) == {"torso"}
    for image_id in sorted(model.reg_image_ids())[9:]:
        model.deregister_frame(model.image(image_id).frame_id)
    assert misfitting_lenses(model, settings, _names(model)) == {}


def test_the_note_says_what_to_do():
    assert "12 % longer" in misfit_note("torso", 1.12)
    assert "12 % shorter" in misfit_note("torso", 0.88)
    assert "stabilisation" in misfit_note("torso", 0.88)
    assert "fit another lens than" in misfit_note("torso", 1.002, freed=True)


def test_a_guessed_lens_that_fits_keeps_its_model():
    model, settings = _model(1.0)
    assert better_lenses(model, settings, set(model.cameras)) == {}
    assert better_lenses(model, settings, set()) == {}


def _guessed(model_name, params, wrong):
    """A map of lenses as given, and the same built with `wrong` ones of one focal length."""
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
    settings = mapper_options(MapOptions(), [], 1.0)
    adjust(model, settings, [], 60)
    return model, settings


def test_a_picture_cropped_off_its_centre_gets_its_principal_point():
    model, settings = _guessed("SIMPLE_RADIAL", [1280, 640, 300, 0.0], [1280, 512, 384, 0.0])
    found = better_lenses(model, settings, set(model.cameras))
    assert set(found) == set(model.cameras)
    for camera in found.values():
        # It was 128 and 84 px off; the mapped points that suited the wrong lens still hold it a little.
        assert camera.model_name == "SIMPLE_RADIAL"
        assert camera.params == pytest.approx([1280, 640, 300, 0.0], abs=15.0)


def test_pixels_that_are_not_square_get_a_focal_length_for_each_axis():
    model, settings = _guessed("PINHOLE", [960, 1280, 512, 384], [1100, 512, 384, 0.0])
    found = better_lenses(model, settings, set(model.cameras))
    assert set(found) == set(model.cameras)
    for camera in found.values():
        assert camera.model_name == "OPENCV"
        assert camera.params[1] / camera.params[0] == pytest.approx(4 / 3, rel=0.01)


def test_a_lens_that_was_given_stays_while_another_is_guessed():
    model, settings = _guessed("SIMPLE_RADIAL", [1280, 640, 300, 0.0], [1280, 512, 384, 0.0])
    first = min(model.cameras)
    assert set(better_lenses(model, settings, {first})) <= {first}
    assert model.camera(first).params[1] == 512


def test_what_is_off_the_centre_is_found_anew_in_a_better_map():
    model, settings = _guessed("SIMPLE_RADIAL", [1280, 640, 300, 0.0], [1280, 600, 330, 0.0])
    found = recentred_lenses(model, settings, set(model.cameras))
    assert set(found) == set(model.cameras)
    assert all(camera.params[1:3] == pytest.approx([640, 300], abs=5.0) for camera in found.values())
    right, settings = _guessed("SIMPLE_RADIAL", [1280, 640, 300, 0.0], [1280, 640, 300, 0.0])
    assert recentred_lenses(right, settings, set(right.cameras)) == {}
    middle, settings = _guessed("SIMPLE_RADIAL", [1280, 640, 300, 0.0], [1280, 512, 384, 0.0])
    assert recentred_lenses(middle, settings, set(middle.cameras)) == {}
