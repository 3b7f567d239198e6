import pytest
from pydantic import ValidationError

from bodycap_batch.model.camera import CAMERA_MODELS
from bodycap_batch.synthetic import SynthOptions


def test_the_default_is_three_cameras_as_in_the_paper():
    options = SynthOptions()
    assert options.cameras == ("torso", "left_palm", "right_palm")
    assert options.frame_count == 360
    assert options.camera().params.tolist() == [420.0, 420.0, 320.0, 240.0]


@pytest.mark.parametrize("model", CAMERA_MODELS)
def test_every_camera_model_has_default_parameters(model):
    camera = SynthOptions(lens=model, width=320, height=240).camera()
    assert camera.focal_px == 210.0
    assert camera.principal_point_px == (160.0, 120.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"cameras": ("elbow_x",)}, "not the name of a place on the body"),
        ({"cameras": ("torso", "torso")}, "each name must occur only once"),
        ({"lens": "MAGIC"}, "no camera model"),
        ({"lens": "OPENCV", "lens_params": (1.0, 2.0)}, "needs 8 parameters"),
        ({"offsets_s": {"head": 0.1}}, "no camera head"),
        ({"offsets_s": {"torso": -5.0}}, "greater than or equal to -3"),
        ({"exposure_s": 0.05}, "time between two frames"),
        ({"rolling_shutter_s": 0.05}, "time between two frames"),
        ({"motion": "walk.bvh", "t_pose_s": 2.0}, "t_pose_s: cannot be used with motion"),
        ({"motion": "walk.bvh", "on_the_spot": True}, "on_the_spot: cannot be used with motion"),
        ({"colour": True}, "Extra inputs"),
        ({"clocks": "own"}, "'common' or 'free'"),
        ({"drifts_ppm": {"torso": 20.0}}, "drifts_ppm: common clocks have no drift"),
        ({"clocks": "free", "drifts_ppm": {"head": 20.0}}, "drifts_ppm: there is no camera head"),
        ({"sound_skews_s": {"torso": 0.02}}, "sound_skews_s: it has no effect without sound"),
        ({"sound_skew_range_s": 0.02}, "sound_skew_range_s: it has no effect without sound"),
        ({"sound": True, "poses_only": True}, "sound: cannot be used with poses_only"),
        ({"stabilised": "recorded", "poses_only": True}, "stabilised: cannot be used with poses_only"),
        ({"sound": True, "seconds": 1300}, "can last 1200 s at most"),
        ({"width": 641}, "multiple of 2"),
    ],
)
def test_invalid_options_are_refused(values, message):
    with pytest.raises(ValidationError, match=message):
        SynthOptions.model_validate(values)


def test_options_survive_json():
    options = SynthOptions(offsets_s={"torso": 0.12}, lens="OPENCV_FISHEYE", seed=7)
    assert SynthOptions.model_validate(options.model_dump(mode="json")) == options
