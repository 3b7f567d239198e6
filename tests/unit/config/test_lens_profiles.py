"""Lenses by name: the table, search, choice by name, and choice by the model in a file."""

import json

import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.check import check_path
from bodycap_batch.cli import main
from bodycap_batch.config import lens_profiles as lenses
from bodycap_batch.config.job import load_job
from bodycap_batch.config.lens_profiles import LensChoice, LensProfile, choose_for_file, choose_named
from bodycap_batch.core.errors import CaptureError, JobError
from bodycap_batch.formats.gpmf_writer import append_settings
from bodycap_batch.model.camera import Camera
from tests.lens_table import TABLE, row
from tests.videos import textured_frame, write_video


def _profile(**values):
    defaults = {
        "brand": "Maker", "model": "Cam 5", "lens": "Wide", "setting": "", "width": 1920, "height": 1080,
        "fps": 29.97, "params": (900.0, 902.0, 960.0, 540.0, 0.04, 0.02, -0.01, 0.002), "rms_px": 0.5,
        "official": False, "stabilised": False, "anamorphic": False, "readout_s": None, "sizes": (),
    }  # fmt: skip
    return LensProfile(**{**defaults, **values})


@pytest.fixture
def table(monkeypatch):
    """Replace the table by profiles of the test."""

    def replace_by(*profiles):
        monkeypatch.setattr(lenses, "lens_profiles", lambda: profiles)

    return replace_by


def test_the_shipped_table_is_small_and_plausible():
    assert TABLE.stat().st_size < 300_000
    profiles = lenses.lens_profiles()
    assert len(profiles) > 3000
    for profile in profiles:
        assert 0 < profile.rms_px <= 2.0
        assert profile.readout_s is None or 0 < abs(profile.readout_s) <= 0.040
        guess = profile.first_guess((profile.width, profile.height))
        assert 0.1 < guess.focal_px / profile.width < 10


@pytest.mark.parametrize(("readout_ms", "kept"), [(0, 0), (16.2, 16.2), (-12.0, -12.0), (55.0, 0), (None, 0)])
def test_unknown_and_absurd_readout_times_are_left_out(readout_ms, kept):
    profile = {
        "brand": "A", "model": "B", "calib": {"w": 1920, "h": 1080},
        "K": [[900, 0, 960], [0, 900, 540], [0, 0, 1]],
        "D": [0, 0, 0, 0], "rms": 0.5, "images": 10, "file": "A/B.json", "readout_ms": readout_ms,
    }  # fmt: skip
    assert row(profile)[-2] == kept
    assert row({**profile, "rms": 2.1}) is None
    assert row({**profile, "file": "A/B anamorph.json"})[-3] == 1
    assert row({**profile, "stretch": 1.33})[-3] == 1


def test_a_choice_prefers_size_rate_official_mark_and_accuracy(table):
    table(
        _profile(width=3840, height=2160, rms_px=0.1),
        _profile(fps=59.94, rms_px=0.2, official=True),
        _profile(rms_px=0.9),
        _profile(rms_px=0.4),
        _profile(rms_px=0.8, official=True),
        _profile(anamorphic=True, rms_px=0.05, official=True),
    )
    choice = choose_for_file("Cam 5", "Wide", (1920, 1080), 30.0)
    assert (choice.profile.rms_px, choice.note) == (0.8, "")
    slow = choose_for_file("Maker Cam 5", "wide", (1920, 1080), 120.0)
    assert "120" in slow.note
    assert isinstance(choose_for_file("Cam 5", "Wide", (1280, 720), 30.0), str)
    assert isinstance(choose_for_file("Cam 6", "Wide", (1920, 1080), 30.0), str)
    assert isinstance(choose_for_file("Cam 5", "Linear", (1920, 1080), 30.0), str)
    scaled = choose_named("Maker Cam 5 / Wide", (1280, 720), 29.97)
    assert "scaled" in scaled.note


def test_lenses_that_differ_are_not_guessed_without_a_mode(table):
    linear = _profile(lens="Linear", params=(905.0, 905.0, 960.0, 540.0, 0.33, 0.1, 0.2, -0.1))
    table(_profile(), linear)
    assert "does not" in choose_for_file("Cam 5", "", (1920, 1080), 30.0)
    assert choose_for_file("Cam 5", "Linear", (1920, 1080), 30.0).profile.lens == "Linear"
    assert "differ" in choose_named("Maker Cam 5 / 1080p", (1920, 1080), 30.0).note
    table(_profile(), _profile(lens="Standard", rms_px=0.7))
    assert isinstance(choose_for_file("Cam 5", "", (1920, 1080), 30.0), LensChoice)


def test_an_anamorphic_lens_is_never_chosen_by_itself(table):
    table(_profile(anamorphic=True), _profile(stabilised=True))
    assert isinstance(choose_for_file("Cam 5", "Wide", (1920, 1080), 30.0), str)
    table(_profile(lens="Wide anamorphic", anamorphic=True))
    assert isinstance(choose_named("Cam 5 / 1080p", (1920, 1080), 30.0), str)
    assert isinstance(choose_named("Cam 5 / Wide anamorphic", (1920, 1080), 30.0), LensChoice)


@pytest.mark.parametrize(
    ("name", "model"),
    [("GoPro HERO11 Black / Wide / 4K", "RADIAL_FISHEYE"), ("GoPro HERO8 Black / Linear / 4K", "RADIAL")],
)
def test_the_first_guess_is_near_the_profile(name, model):
    profile = choose_named(name, (3840, 2160), 29.97).profile
    guess = profile.first_guess((960, 540))
    fx, fy, cx, cy, *radial = profile.params
    exact = Camera(
        model="OPENCV_FISHEYE",
        width_px=profile.width,
        height_px=profile.height,
        params=[fx, fy, cx + 0.5, cy + 0.5, *radial],
    ).scaled(960, 540)
    assert guess.model == model
    assert guess.refine
    angles = np.linspace(-0.75, 0.75, 20)
    points = np.stack([np.sin(angles), 0.3 * np.sin(angles), np.cos(angles)], axis=1)
    truth = exact.project(points)
    inside = (np.abs(truth - [480.0, 270.0]) < [480.0, 270.0]).all(axis=1)
    assert inside.sum() >= 12
    np.testing.assert_allclose(guess.project(points)[inside], truth[inside], atol=2.0)
    assert guess.focal_px == pytest.approx(exact.focal_px, rel=0.02)


@pytest.mark.parametrize("turning", [False, True])
def test_a_lens_that_two_terms_do_not_describe_keeps_its_four_terms(turning):
    """If the curve of a profile turns well inside the image, its terms have no inverse there."""
    last = -0.45 if turning else 0.12
    profile = _profile(params=(880.0, 900.0, 950.0, 545.0, 0.04, 0.14, -0.23, last))
    guess = profile.first_guess((960, 540))
    if turning:
        assert guess.model in ("RADIAL", "RADIAL_FISHEYE")
        return
    assert guess.model == "OPENCV_FISHEYE"
    np.testing.assert_allclose(guess.params[:4], [445.0, 445.0, 475.25, 272.75])
    theta = np.linspace(0.05, 0.9, 30)
    in_cam = np.column_stack([np.sin(theta), np.zeros(30), np.cos(theta)])
    radius = guess.project(in_cam)[:, 0] - guess.principal_point_px[0]
    exact = 960 * np.array([profile.place_of(angle) for angle in theta])
    np.testing.assert_allclose(radius, exact, atol=1e-6)


def _gopro(folder, settings, size=(1920, 1080)):
    frames = [textured_frame(index % 40, *size) for index in range(20)]
    path = write_video(folder / "torso.mp4", frames)
    append_settings(path, settings)
    return path


MAX_WIDE = {"MINF": "GoPro Max", "VFOV": "W"}


def test_the_lens_of_a_known_model_is_the_first_guess(tmp_path):
    _gopro(tmp_path, MAX_WIDE)
    capture = open_capture(load_job(tmp_path).capture)
    (camera,) = capture.cameras
    assert camera.camera.model == "OPENCV_FISHEYE"
    assert camera.camera.refine
    assert not camera.calibrated
    (found,) = check_path(tmp_path).cameras
    assert found.origins.first_guess.source == "lens profile"
    assert "GoPro Max / Wide / 1920x1080" in found.origins.first_guess.value
    assert any("the video has 30 fps" in note for note in found.notes)


@pytest.mark.parametrize("settings", [{**MAX_WIDE, "EISE": "Y"}, {"MINF": "Unknown", "VFOV": "W"}, {}])
def test_no_lens_is_guessed_for_stabilised_videos_and_unknown_models(tmp_path, settings):
    _gopro(tmp_path, settings)
    (camera,) = open_capture(load_job(tmp_path).capture).cameras
    assert camera.camera.model == "SIMPLE_RADIAL"


def test_a_field_of_view_in_the_job_has_priority(tmp_path):
    _gopro(tmp_path, MAX_WIDE)
    (tmp_path / "job.yaml").write_text(
        "capture: {cameras: [{name: torso, video: torso.mp4, fov_deg: 80}]}\nskeleton: none\n"
    )
    (camera,) = open_capture(load_job(tmp_path).capture).cameras
    assert camera.camera.model == "SIMPLE_RADIAL"


def _job(folder, name):
    path = folder / "job.yaml"
    path.write_text(
        f"capture:\n  calibration: {name}\n  cameras: [{{name: torso, video: torso.mp4}}]\nskeleton: none\n"
    )
    return path


def test_a_job_names_a_lens(tmp_path):
    write_video(tmp_path / "torso.mp4", [textured_frame(index % 40, 384, 216) for index in range(20)])
    job = load_job(_job(tmp_path, "GoPro HERO11 Black / Wide / 4K"))
    assert job.capture.cameras[0].calibration == "GoPro HERO11 Black / Wide / 4K"
    (camera,) = open_capture(job.capture).cameras
    assert camera.camera.model in ("RADIAL", "RADIAL_FISHEYE")
    assert camera.camera.refine
    (found,) = check_path(tmp_path).cameras
    assert found.origins.calibration.value == "GoPro HERO11 Black / Wide / 4K"


def test_wrong_names_are_errors_with_offers(tmp_path):
    write_video(tmp_path / "torso.mp4", [textured_frame(index, 64, 48) for index in range(20)])
    with pytest.raises(JobError, match="did you mean GoPro HERO11 Black") as raised:
        load_job(_job(tmp_path, "GoPro HERO11 Blck / Wide"))
    assert "calibration" in raised.value.field
    with pytest.raises(JobError, match="profiles of this camera are"):
        load_job(_job(tmp_path, "GoPro HERO11 Black / Wde"))
    with pytest.raises(CaptureError, match="the shapes differ") as shape:
        open_capture(load_job(_job(tmp_path, "GoPro HERO11 Black / Narrow")).capture)
    assert shape.value.hint


def test_the_command_searches(capsys):
    assert main(["lenses", "hero11", "wide", "4k"]) == 0
    assert "GoPro HERO11 Black / Wide / 3840x2160" in capsys.readouterr().out
    assert main(["lenses", "hero11", "--json"]) == 0
    assert all("HERO11" in each["model"] for each in json.loads(capsys.readouterr().out))
    assert main(["lenses", "nothing", "like", "it"]) == 2
