"""Pictures against the gyroscope: delay, rotation, bias, rate, and stabilised pictures."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodycap_batch.cli import main
from bodycap_batch.telemetry.comparison import judge_rotations
from bodycap_batch.telemetry.picture_rotation import PictureRotation
from bodycap_batch.telemetry.streams import CameraTelemetry, Stream
from tests.gpmf import Sensor, item, nested, payloads, write_gopro

FPS = 30000 / 1001
_RNG = np.random.default_rng(4)
WAVES = _RNG.uniform([0.3, -0.5, -0.5, -0.5, 0.0], [4.0, 0.5, 0.5, 0.5, 6.0], (12, 5))
"""Frequencies (Hz), amplitudes (rad/s) along three axes, and phases of the angular rate."""


def _rate(times):
    """Angular rates (N,3) in the axes of the camera, rad/s."""
    waves = np.sin(2 * np.pi * WAVES[:, 0] * times[:, None] + WAVES[:, 4])
    return waves @ WAVES[:, 1:4]


def _orientations(times, rate=_rate):
    """World_from_camera of each time, integrated finely."""
    fine = np.arange(0, times[-1] + 0.01, 5e-4)
    steps = Rotation.from_rotvec(rate(fine + 2.5e-4) * 5e-4)
    out, index = [], 0
    now = Rotation.identity()
    for time in times:
        while fine[index] < time - 1e-9:
            now, index = now * steps[index], index + 1
        out.append(now)
    return Rotation.concatenate(out)


def _picture(orientation, times, noise=0.0005, ratio=1.0, seed=0):
    turn = (orientation[:-1].inv() * orientation[1:]).as_rotvec() * ratio
    turn = turn + np.random.default_rng(seed).normal(0, noise, turn.shape)
    return PictureRotation(start_s=times[:-1], end_s=times[1:], turn_rad=turn)


def _gyro(seconds, turned, bias, delay, rate_hz=200.0, drift=0.0):
    times = np.arange(-0.5, seconds + 0.5, 1 / rate_hz)
    values = _rate((times - delay) / (1 + drift)) @ turned.as_matrix() + bias
    values += np.random.default_rng(1).normal(0, 0.005, values.shape)
    return Stream(key="GYRO", name="", unit="rad/s", times_s=times, values=values, rate_hz=rate_hz)


@pytest.fixture(scope="module")
def path():
    times = np.arange(0, 240) / FPS
    return times, _orientations(times)


@pytest.mark.parametrize(
    ("turned_deg", "axes_known"),
    [([1.5, -1.0, 2.0], True), ([0.0, 0.0, 0.0], True), ([20.0, 170.0, -60.0], False)],
)
@pytest.mark.parametrize("delay", [-0.016, 0.0083])
def test_delay_rotation_bias_and_lens(path, turned_deg, axes_known, delay):
    times, orientation = path
    turned = Rotation.from_rotvec(np.radians(turned_deg))
    bias = np.array([0.01, -0.008, 0.012])
    gyro = _gyro(8, turned, bias, delay)
    result = judge_rotations(
        _picture(orientation, times, ratio=1.12), gyro, CameraTelemetry(axes_known=axes_known)
    )
    assert result.verdict == "agrees"
    fit = result.best
    assert fit.r_squared > 0.99
    assert fit.delay_s == pytest.approx(delay, abs=0.0006)
    assert 0 < fit.delay_sigma_s < 0.001
    error = Rotation.from_matrix(fit.cam_from_sensor @ turned.as_matrix().T).magnitude()
    assert np.degrees(error) < 0.5
    np.testing.assert_allclose(fit.bias_rad_s, bias, atol=0.006)
    assert fit.focal_ratio == pytest.approx(1.12, abs=0.01)


def test_the_rate_of_the_clock(path):
    times, orientation = path
    gyro = _gyro(9, Rotation.identity(), np.zeros(3), 0.01, drift=0.002)
    fit = judge_rotations(_picture(orientation, times), gyro, CameraTelemetry(axes_known=True)).best
    # The delay is that of the middle of the clip.
    assert fit.drift == pytest.approx(0.002, abs=0.0004)
    assert fit.delay_s == pytest.approx(0.01 + 0.002 * 4.0, abs=0.001)


def test_residuals_that_last_raise_the_stated_sigma(path):
    times, orientation = path
    gyro = _gyro(8, Rotation.identity(), np.zeros(3), 0.008)
    clean = _picture(orientation, times)
    # A walk beside a wall: the translation looks like slow rotations.
    slow = 0.006 * np.sin(2 * np.pi * np.outer(clean.start_s, [1.1, 0.7, 0.9]) + [0.0, 1.0, 2.0])
    walking = replace(clean, turn_rad=clean.turn_rad + slow)
    telemetry = CameraTelemetry(axes_known=True)
    plain, disturbed = (judge_rotations(each, gyro, telemetry).fit for each in (clean, walking))
    # Residuals of 0.9 Hz last for some ten pairs; as independent ones they would state a fifth of this.
    assert disturbed.delay_sigma_s > 10 * plain.delay_sigma_s
    assert abs(disturbed.delay_s - 0.008) < 3 * disturbed.delay_sigma_s


def _stabilised(times, orientation):
    """The image's orientations follow slow turns only, and how the image is turned relative to the camera."""
    smooth = [orientation[max(0, index - 20) : index + 21].mean() for index in range(len(times))]
    image = Rotation.concatenate(smooth)
    return image, orientation.inv() * image


@pytest.mark.slow
def test_stabilised_pictures_are_named_and_undone(path):
    times, orientation = path
    image, cam_from_image = _stabilised(times, orientation)
    gyro = _gyro(8, Rotation.identity(), np.zeros(3), 0.0)
    plain = judge_rotations(_picture(image, times), gyro, CameraTelemetry(axes_known=True))
    assert plain.verdict == "stabilised"
    assert plain.best is None
    assert "it cannot be undone, because the camera recorded no orientations" in plain.reason
    xyzw = cam_from_image.as_quat(scalar_first=False)
    recorded = np.column_stack([xyzw[:, 3], -xyzw[:, :3]])
    stream = Stream(key="IORI", name="", unit="1", times_s=times, values=recorded, rate_hz=FPS)
    telemetry = CameraTelemetry(axes_known=True, streams={"IORI": stream})
    result = judge_rotations(_picture(image, times, ratio=0.93), gyro, telemetry)
    assert result.verdict == "stabilised"
    assert result.best.r_squared > 0.95
    assert result.best.delay_s == pytest.approx(0.0, abs=0.001)
    wrong = Stream(key="IORI", name="", unit="1", times_s=times, values=recorded[::-1], rate_hz=FPS)
    result = judge_rotations(
        _picture(image, times), gyro, CameraTelemetry(axes_known=True, streams={"IORI": wrong})
    )
    assert result.verdict == "stabilised"
    assert result.best is None
    assert "it cannot be undone: with" in result.reason


def test_samples_of_another_video_are_not_called_stabilised(path):
    times, orientation = path
    gyro = _gyro(30, Rotation.identity(), np.zeros(3), 20.0)
    result = judge_rotations(_picture(orientation, times), gyro, CameraTelemetry(axes_known=True))
    assert result.verdict == "unknown"
    assert "another video" in result.reason


def test_a_camera_that_hardly_turns_is_not_judged(path):
    times, _ = path
    gyro = _gyro(8, Rotation.identity(), np.zeros(3), 0.0)
    still = Stream(
        key="GYRO", name="", unit="rad/s", times_s=gyro.times_s, values=0.001 * gyro.values, rate_hz=200.0
    )
    rest = Rotation.identity(len(times))
    result = judge_rotations(_picture(rest, times), still, CameraTelemetry(axes_known=True))
    assert result.verdict == "unknown"
    assert "turns too little" in result.reason
    few = _picture(rest, times).chosen(np.arange(10))
    assert judge_rotations(few, gyro, CameraTelemetry()).verdict == "unknown"


def _clip(folder, *, stabilised):
    """A camera that turns before a far wall with texture, and a GoPro's gyroscope."""
    rng = np.random.default_rng(0)
    wall = cv2.resize(
        rng.integers(0, 255, (90, 120), dtype=np.uint8), (1440, 1080), interpolation=cv2.INTER_CUBIC
    )
    times = np.arange(0, 120) / FPS

    def gentle(moments):
        return 0.5 * _rate(moments)

    pan = Rotation.from_rotvec(np.outer(times, [0.0, 0.12, 0.0]))
    orientation = pan if stabilised else _orientations(times, gentle)
    focal = 320 / 2 / np.tan(np.radians(35))
    lens = np.array([[focal, 0, 160], [0, focal, 120], [0, 0, 1]])
    wide = np.array([[focal, 0, 720], [0, focal, 540], [0, 0, 1]])
    frames = [
        cv2.warpPerspective(wall, lens @ matrix.T @ np.linalg.inv(wide), (320, 240), flags=cv2.INTER_AREA)
        for matrix in orientation.as_matrix()
    ]

    def sensor_rate(moments):
        rate = gentle(moments)
        return np.stack([-rate[:, 0], -rate[:, 2], -rate[:, 1]], axis=1)

    settings = nested("STRM", item("SHUT", "f", [0.001] * 30))
    return write_gopro(folder / "torso.mp4", frames, payloads(Sensor(), 4, sensor_rate, extra=[settings]))


def test_the_command_compares_on_request(tmp_path, capsys):
    clip = _clip(tmp_path, stabilised=False)
    assert main(["telemetry", str(clip), "--compare"]) == 0
    out = capsys.readouterr().out
    assert "pictures and gyroscope turn together" in out
    assert "delay" in out


@pytest.mark.slow
def test_check_notes_a_stabilised_video(tmp_path, capsys):
    _clip(tmp_path, stabilised=True)
    main(["check", str(tmp_path), "--skeleton", "none"])
    assert "torso: the camera stabilised the video" in capsys.readouterr().out


def test_check_notes_damaged_telemetry_and_uses_the_video(tmp_path, capsys):
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (48, 64), dtype=np.uint8) for _ in range(90)]
    track = payloads(Sensor(), 3)
    data, start, duration = track[1]
    write_gopro(
        tmp_path / "torso.mp4", frames, [track[0], (data[: len(data) // 2], start, duration), track[2]]
    )
    code = main(["check", str(tmp_path), "--skeleton", "none"])
    out = capsys.readouterr().out
    assert code == 0
    assert "torso: an item of the telemetry is cut off" in out
    (tmp_path / "torso.imu.csv").write_text("hello")
    assert main(["check", str(tmp_path), "--skeleton", "none"]) == 0
    assert "its samples are not used" in capsys.readouterr().out
