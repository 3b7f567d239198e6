"""A map tells when the given lens is not the one that filmed."""

import numpy as np
import pycolmap
import pytest

from bodycap_batch.config import MapOptions
from bodycap_batch.mapping.lens import better_lenses, misfit_note, misfitting_lenses
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
