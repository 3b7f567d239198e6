"""Small synthetic captures: layout, clocks, determinism, failures."""

import errno
import hashlib
import json

import av
import numpy as np
import pytest

from bodycap_batch.capture import open_capture
from bodycap_batch.clocks import estimate_clocks
from bodycap_batch.config.job import load_job
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import Cancelled, JobError, StoreError
from bodycap_batch.formats.atomic_files import store_error_from_os_error
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.tum import read_tum
from bodycap_batch.model.geometry import interpolate_pose, invert, rotation_angle_rad
from bodycap_batch.model.nominal_mounts import nominal_mount
from bodycap_batch.model.skeleton_presets import load_skeleton, rest_positions
from bodycap_batch.synthetic import SynthOptions, synthesise
from bodycap_batch.synthetic.clocks import true_clocks

TINY = {"width": 64, "height": 48, "seconds": 0.3, "cameras": ("torso", "left_palm"), "furnished": False}


def _make(folder, progress=None, cancelled=None, **values):
    hooks = {"progress": progress} if progress else {}
    hooks |= {"cancelled": cancelled} if cancelled else {}
    context = StageContext(work_dir=folder.parent, threads=2, **hooks)
    synthesise(SynthOptions(**{**TINY, **values}), folder, context)
    return folder


def _frames(path):
    with av.open(str(path)) as video:
        return [frame.to_ndarray(format="rgb24").astype(float) for frame in video.decode(video=0)]


def _digests(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return _make(tmp_path_factory.mktemp("synthetic") / "capture")


def test_the_layout(capture):
    names = {str(path.relative_to(capture)) for path in capture.rglob("*") if path.is_file()}
    assert names == {
        *("torso.mp4", "left_palm.mp4", "calib.json", "skeleton.bvh"),
        *("gt/torso.tum", "gt/left_palm.tum", "gt/joints.npz", "gt/motion.bvh"),
        *("gt/mounts.json", "gt/README.txt", "gt/synth.json"),
    }
    assert [path.name for path in capture.parent.iterdir()] == ["capture"]
    calib = json.loads((capture / "calib.json").read_text())
    assert calib["model"] == "PINHOLE"
    assert calib["params"] == [42.0, 42.0, 32.0, 24.0]
    assert calib["offsets_s"] == {"torso": 0.0, "left_palm": 0.0}
    text = "".join(p.read_text() for p in capture.rglob("*") if p.suffix in (".json", ".tum", ".bvh", ".txt"))
    assert str(capture.parent) not in text


def test_truth_stays_out_of_what_a_job_reads(capture):
    assert "joint_from_cam" not in (capture / "calib.json").read_text()
    assert "seed" not in (capture / "calib.json").read_text()


def test_a_job_opens_the_folder(capture):
    opened = open_capture(load_job(capture).capture)
    assert [camera.name for camera in opened.cameras] == ["left_palm", "torso"]
    for camera in opened.cameras:
        assert camera.calibrated
        truth = read_tum(capture / "gt" / f"{camera.name}.tum")
        assert len(camera.times_ns) == 9
        # The container counts in 1/15360 s: exact at 30 frames per second, up to a nanosecond.
        assert np.abs(camera.times_ns - truth.times_ns).max() <= 1


def test_truth_agrees_with_itself(capture):
    """Cameras = joints of motion.bvh · mounts.json; joints.npz = the same joints."""
    skeleton, motion = read_bvh(capture / "gt" / "motion.bvh")
    mounts = json.loads((capture / "gt" / "mounts.json").read_text())
    joints = motion.world_from_joint()
    data = np.load(capture / "gt" / "joints.npz")
    assert data["world"].shape == (9, 15, 3)
    names = data["names"].tolist()
    # BVH angles have 6 decimals in degrees, lengths 8 in metres: micrometres at an arm's length.
    for name, role in (("torso", "Spine1"), ("left_palm", "LeftHand"), ("right_ankle", "RightFoot")):
        bone = joints[:, skeleton.index_of_role(role), :3, 3]
        assert np.abs(data["world"][:, names.index(name)] - bone).max() < 1e-5
    for name, mount in mounts.items():
        truth = read_tum(capture / "gt" / f"{name}.tum")
        seen = joints[:, skeleton.index_of_role(mount["role"])] @ np.array(mount["joint_from_cam"])
        assert np.abs(seen[:, :3, 3] - truth.world_from_cam[:, :3, 3]).max() < 1e-5
        turned = rotation_angle_rad(invert(seen)[:, :3, :3] @ truth.world_from_cam[:, :3, :3])
        assert turned.max() < 1e-5


def test_mounts_and_bones_are_off_nominal(capture):
    mounts = json.loads((capture / "gt" / "mounts.json").read_text())
    nominal_body = load_skeleton("full_body", 1.75)
    for name, mount in mounts.items():
        nominal = nominal_mount(name, mount["role"], nominal_body).joint_from_cam
        off = invert(nominal) @ np.array(mount["joint_from_cam"])
        # σ = 15° and 5 cm in all; a Maxwell variable is below 5 % of it in 1 of 5,000 draws.
        assert 0.7 < np.degrees(rotation_angle_rad(off[:3, :3])) < 45
        assert 0.0025 < np.linalg.norm(off[:3, 3]) < 0.15
    body, _ = read_bvh(capture / "skeleton.bvh")
    moving, _ = read_bvh(capture / "gt" / "motion.bvh")
    assert np.allclose(rest_positions(body) - body.offsets_m[0], rest_positions(moving) - moving.offsets_m[0])
    ratio = np.linalg.norm(body.offsets_m[1:], axis=1) / np.linalg.norm(nominal_body.offsets_m[1:], axis=1)
    assert ratio.std() > 0.01


def test_same_options_same_files_and_another_seed_another_capture(capture, tmp_path):
    again = _make(tmp_path / "again")
    assert _digests(again) == _digests(capture)
    other = _digests(_make(tmp_path / "other", seed=1))
    assert other["torso.mp4"] != _digests(capture)["torso.mp4"]
    assert other["skeleton.bvh"] != _digests(capture)["skeleton.bvh"]


def test_a_clock_offset_shifts_what_a_camera_sees_and_where_it_is(capture, tmp_path):
    late = _make(tmp_path / "late", offsets_s={"left_palm": 0.1})
    assert json.loads((late / "calib.json").read_text())["offsets_s"] == {"torso": 0.0, "left_palm": 0.1}
    here, there = (read_tum(folder / "gt" / "left_palm.tum") for folder in (late, capture))
    assert (here.times_ns == there.times_ns).all()
    # Common time = camera time + 0.1 s: its frame 0 is the synchronous camera's frame 3.
    assert np.abs(here.world_from_cam[:6] - there.world_from_cam[3:]).max() < 1e-6
    seen, expected = _frames(late / "left_palm.mp4"), _frames(capture / "left_palm.mp4")
    right = np.abs(seen[0] - expected[3]).mean()
    wrong = np.abs(seen[0] - expected[0]).mean()
    assert right < 0.5 * wrong
    data = np.load(late / "gt" / "joints.npz")
    assert data["t"][0] == 0.0
    assert data["t"][-1] == pytest.approx(8 / 30 + 0.1, abs=1 / 30)


def test_free_clocks_are_only_in_the_truth_and_agree_with_the_cameras(tmp_path):
    cameras = ("head", "torso", "left_palm")
    folder = _make(
        tmp_path / "free",
        clocks="free",
        poses_only=True,
        seconds=16.0,
        cameras=cameras,
        drifts_ppm={"left_palm": 1000.0},
        offsets_s={"left_palm": -0.7},
    )
    assert "offsets_s" not in json.loads((folder / "calib.json").read_text())
    clocks = json.loads((folder / "gt" / "clocks.json").read_text())
    assert clocks["reference"] == "torso"
    assert (clocks["offsets_s"]["torso"], clocks["drifts_ppm"]["torso"]) == (0.0, 0.0)
    assert (clocks["offsets_s"]["left_palm"], clocks["drifts_ppm"]["left_palm"]) == (-0.7, 1000.0)
    assert 0.0 < abs(clocks["offsets_s"]["head"]) <= 3.0
    assert 0.0 < abs(clocks["drifts_ppm"]["head"]) <= 50.0
    skeleton, motion = read_bvh(folder / "gt" / "motion.bvh")
    joints = motion.world_from_joint()
    mounts = json.loads((folder / "gt" / "mounts.json").read_text())
    ticks_s = np.load(folder / "gt" / "joints.npz")["t"]
    for name in cameras:
        truth = read_tum(folder / "gt" / f"{name}.tum")
        common_s = truth.times_ns * 1e-9 * (1 + 1e-6 * clocks["drifts_ppm"][name])
        common_s += clocks["offsets_s"][name]
        assert ticks_s[0] <= common_s[0] + 1e-9
        assert common_s[-1] < ticks_s[-1] + 1 / 30
        place = joints[:, skeleton.index_of_role(mounts[name]["role"])]
        path = (place @ np.array(mounts[name]["joint_from_cam"]))[:, :3, 3]
        inside = common_s <= ticks_s[-1]
        expected = np.stack([np.interp(common_s[inside], ticks_s, path[:, axis]) for axis in range(3)], 1)
        error_m = np.abs(expected - truth.world_from_cam[inside, :3, 3])
        # A palm accelerates with up to 20 m/s²: a line between ticks is off by 1/8 of that times (1/30 s)².
        assert error_m.max() < 0.003
    # The drift alone moves the palm by up to 16 ms, which is more than 1 cm at 1 m/s.
    undrifted = truth.times_ns * 1e-9 - 0.7
    moved = np.stack([np.interp(undrifted, ticks_s, path[:, axis]) for axis in range(3)], 1)
    assert np.abs(moved - truth.world_from_cam[:, :3, 3]).max() > 0.01


def test_free_clocks_are_drawn_from_the_seed_and_a_quarter_of_the_length(tmp_path):
    drawn = []
    for seed in range(3):
        options = SynthOptions(clocks="free", seconds=8.0, seed=seed)
        clocks = true_clocks(options)
        assert clocks == true_clocks(options)
        drawn.append([clocks[name].offset_s for name in ("left_palm", "right_palm")])
    assert np.abs(drawn).max() <= 2.0
    assert len(np.unique(drawn)) == 6
    stated = true_clocks(SynthOptions(clocks="free", seconds=8.0, seed=2, offsets_s={"left_palm": 1.0}))
    assert (stated["left_palm"].offset_s, stated["right_palm"].offset_s) == (1.0, drawn[2][1])


def test_a_motion_file_starts_with_the_earliest_free_camera(capture, tmp_path):
    longer = _make(tmp_path / "longer", poses_only=True, seconds=3.0, cameras=("torso",))
    options = {
        "motion": longer / "gt" / "motion.bvh", "clocks": "free", "poses_only": True, "seconds": 2.0,
        "offsets_s": {"left_palm": -0.5}, "drifts_ppm": {"left_palm": 0.0},
    }  # fmt: skip
    folder = _make(tmp_path / "moved", **options)
    _, given = read_bvh(longer / "gt" / "motion.bvh")
    _, followed = read_bvh(folder / "gt" / "motion.bvh")
    assert followed.start_ns == -500_000_000 or len(followed.local_rotation) == 75
    assert np.abs(followed.local_rotation[:75] - given.local_rotation[:75]).max() < 1e-6


def test_videos_have_sound_from_which_the_clocks_are_found(tmp_path):
    values = {
        "clocks": "free", "sound": True, "sound_ratio_db": 20.0, "seconds": 8.0, "fps": 5.0, "seed": 4,
        "sound_skews_s": {"left_palm": 0.05}, "width": 32, "height": 32,
    }  # fmt: skip
    folder = _make(tmp_path / "sound", **values)
    with av.open(str(folder / "torso.mp4")) as video:
        sound = video.streams.audio[0]
        assert sound.codec_context.name == "aac"
        assert float(sound.duration * sound.time_base) == pytest.approx(8.0, abs=0.05)
        assert len([0 for packet in video.demux(video.streams.video[0]) if packet.size]) == 40
    clocks = json.loads((folder / "gt" / "clocks.json").read_text())
    assert clocks["sound_skews_s"] == {"torso": 0.0, "left_palm": 0.05}
    found = estimate_clocks(load_job(folder).capture, 1)
    assert found.reference == clocks["reference"]
    clock = found.camera("left_palm")
    assert clock.source == "sound"
    # The sound of the palm is late by 50 ms, so its clock seems to start that much earlier.
    expected_s = clocks["offsets_s"]["left_palm"] - 0.05
    assert clock.offset_s == pytest.approx(expected_s, abs=0.004)  # the way of sound to both


def test_sound_does_not_change_the_pictures_and_the_truth_names_it(capture, tmp_path):
    folder = _make(tmp_path / "sound", sound=True)
    for name in ("torso", "left_palm"):
        assert np.array_equal(_frames(folder / f"{name}.mp4"), _frames(capture / f"{name}.mp4"))
    assert json.loads((folder / "calib.json").read_text())["offsets_s"] == {"torso": 0.0, "left_palm": 0.0}
    assert json.loads((folder / "gt" / "synth.json").read_text())["sound"] is True
    assert json.loads((capture / "gt" / "synth.json").read_text())["sound"] is False


def test_lost_frames_come_with_their_times(tmp_path):
    folder = _make(tmp_path / "lossy", drop_frames=0.4, seconds=1.0, cameras=("torso",))
    times = [float(line) for line in (folder / "torso.timestamps.txt").read_text().split()]
    assert 10 < len(times) < 27
    assert len(_frames(folder / "torso.mp4")) == len(times)
    truth = read_tum(folder / "gt" / "torso.tum")
    assert np.allclose(truth.times_ns * 1e-9, times)
    assert np.allclose(np.array(times) * 30, np.round(np.array(times) * 30), atol=1e-6)
    assert (times[0], round(times[-1] * 30)) == (0.0, 29)


def test_poses_only(tmp_path):
    folder = _make(
        tmp_path / "poses", poses_only=True, seconds=40, cameras=("torso", "left_palm", "right_palm")
    )
    assert not list(folder.glob("*.mp4"))
    for name in ("torso", "left_palm", "right_palm"):
        truth, seen = (read_tum(folder / where / f"{name}.tum") for where in ("gt", "poses"))
        index = np.searchsorted(truth.times_ns, seen.times_ns)
        assert (truth.times_ns[index] == seen.times_ns).all()
        assert 1200 - len(seen.times_ns) == 24  # 2 % of 1,200, the default
        missing = np.setdiff1d(np.arange(1200), index)
        # Two gaps of 10 to 20 frames, or one and the rest of another; they may touch.
        assert (np.diff(missing) > 1).sum() <= 2
        off = invert(truth.world_from_cam[index]) @ seen.world_from_cam
        shift = np.linalg.norm(seen.world_from_cam[:, :3, 3] - truth.world_from_cam[index, :3, 3], axis=1)
        gross = shift > 0.04  # eight sigma of 5 mm
        assert 0.005 < gross.mean() < 0.03
        # About 800 poses of three axes: the RMS to 2 %, five sigma of that is 10 %.
        assert np.sqrt((shift[~gross] ** 2).mean() / 3) == pytest.approx(0.005, rel=0.1)
        turned = np.degrees(rotation_angle_rad(off[~gross, :3, :3]))
        assert np.sqrt((turned**2).mean() / 3) == pytest.approx(0.3, rel=0.1)


def test_a_camera_may_run_at_its_own_rate(tmp_path):
    folder = _make(
        tmp_path / "rates",
        poses_only=True,
        seconds=2,
        cameras=("torso", "left_palm"),
        rates_fps={"left_palm": 24.0},
        lost=0.0,
    )
    times = {name: read_tum(folder / "poses" / f"{name}.tum").times_ns for name in ("torso", "left_palm")}
    assert (len(times["torso"]), len(times["left_palm"])) == (60, 48)
    assert times["left_palm"][24] == 1_000_000_000
    assert json.loads((folder / "calib.json").read_text())["rates_fps"] == {"left_palm": 24.0}


def test_a_motion_file_is_followed(capture, tmp_path):
    folder = _make(tmp_path / "moved", motion=capture / "gt" / "motion.bvh", seconds=0.2, cameras=("torso",))
    _, given = read_bvh(capture / "gt" / "motion.bvh")
    _, followed = read_bvh(folder / "gt" / "motion.bvh")
    # The same rotations (6 decimals of a degree), moved to the middle of the room.
    assert np.abs(followed.local_rotation - given.local_rotation[:6]).max() < 1e-6
    moved = followed.root_in_world_m - given.root_in_world_m[:6]
    assert np.ptp(moved, axis=0).max() < 1e-6
    assert json.loads((folder / "gt" / "synth.json").read_text())["motion"] == "motion.bvh"


def test_blur_rolling_shutter_body_and_fisheye_together(tmp_path):
    folder = _make(
        tmp_path / "all",
        seconds=0.1,
        cameras=("right_palm",),
        lens="OPENCV_FISHEYE",
        lens_params=(24.0, 24.0, 32.0, 24.0, 0.02, -0.005, 0.0, 0.0),
        exposure_s=0.015,
        rolling_shutter_s=0.02,
        body_in_view=True,
        furnished=True,
        repeated_posters=True,
    )
    frames = _frames(folder / "right_palm.mp4")
    assert len(frames) == 3
    assert all(frame.std() > 15 for frame in frames)
    calib = json.loads((folder / "calib.json").read_text())
    assert (calib["rolling_shutter_s"], calib["exposure_s"], calib["model"]) == (
        0.02,
        0.015,
        "OPENCV_FISHEYE",
    )
    middle, mean = (read_tum(folder / "gt" / part / "right_palm.tum") for part in ("", "exposure"))
    assert (middle.times_ns == mean.times_ns).all()
    off_m = np.linalg.norm(middle.world_from_cam[:, :3, 3] - mean.world_from_cam[:, :3, 3], axis=1)
    # Accelerations of a walk up to 40 m/s²: a · T² / 24.
    assert (off_m > 0.0).all()
    assert (off_m < 40.0 * 0.015**2 / 24.0).all()


def test_progress_counts_every_frame(tmp_path):
    calls = []
    _make(tmp_path / "c", progress=lambda *call: calls.append(call), seconds=0.1)
    assert calls[0] == (0, 6, "room")
    assert calls[1:] == [(n, 6, "torso" if n <= 3 else "left_palm") for n in range(1, 7)]


def test_cancelling_leaves_no_files(tmp_path):
    with pytest.raises(Cancelled):
        _make(tmp_path / "c", cancelled=lambda: True)
    assert not list(tmp_path.iterdir())


def test_a_folder_in_use_is_not_changed(capture, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("important")
    with pytest.raises(JobError, match="exists already"):
        _make(tmp_path / "mine")
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["thesis.txt"]


def test_a_disk_that_refuses_a_file_is_reported(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StoreError, match="cannot be written"):
        _make(tmp_path / "file" / "capture", poses_only=True)


def test_frames_lie_between_their_neighbours(capture):
    truth = read_tum(capture / "gt" / "torso.tum").world_from_cam
    middle = interpolate_pose(truth[:-2], truth[2:], 0.5)
    # Accelerations stay below 10 m/s²: half of that times (1/30 s)² is 6 mm.
    assert np.abs(middle[:, :3, 3] - truth[1:-1, :3, 3]).max() < 0.006


def test_a_full_disk_is_reported_and_leaves_no_files(tmp_path, monkeypatch):
    class Full:
        def __init__(self, *arguments, **_):
            self.path = arguments[0]

        def __enter__(self):
            return self

        def __exit__(self, *_):
            return None

        def add(self, image):
            raise store_error_from_os_error(OSError(errno.ENOSPC, "No space left on device"), self.path)

    monkeypatch.setattr("bodycap_batch.synthetic.making.VideoWriter", Full)
    with pytest.raises(StoreError, match="No space left") as caught:
        _make(tmp_path / "c", seconds=0.1)
    assert caught.value.path == str(tmp_path / "c" / "torso.mp4")
    assert "free some space" in caught.value.hint
    assert not list(tmp_path.iterdir())
