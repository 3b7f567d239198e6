"""Parts of the benchmarks: the peers' pairs, their time limit, reading a job's events."""

import json

import av
import numpy as np

from bodycap_batch.evaluate.trajectories import interpolate_truth
from bodycap_batch.formats.frame_table import COLUMNS
from bodycap_batch.formats.tum import TimedPoses
from bodycap_batch.model.geometry import Similarity, make_transform, so3_exp
from bodycap_batch.synthetic import SynthOptions
from tests.bench import bare, bare_draw, long, ours, peers, poses, scaling, seeds, solving, violent
from tests.bench.peer_pairs import AWAY_NS, FROM_OTHER, OWN_AGAIN, STEPS, pairs_of
from tests.bench.rows import Row, row_of
from tests.scenes import small_map
from tests.videos import write_video


def _frames(count, cameras=("a", "b")):
    names = np.repeat(np.array(cameras), count)
    return names, np.tile(np.arange(count, dtype=np.int64) * 33_000_000, len(cameras))


def test_peer_pairs_hold_neighbours_and_the_same_instant():
    names, times = _frames(100)
    pairs = set(pairs_of(names, times, np.zeros((200, 200))))
    assert {(0, step) for step in STEPS} <= pairs
    assert {(row, row + 100) for row in range(100)} <= pairs
    assert all(first < second for first, second in pairs)


def test_peer_pairs_follow_the_retrieval_but_not_to_neighbours():
    names, times = _frames(200, ("a",))
    alike = np.zeros((200, 200))
    alike[10, 150] = 1.0
    alike[10, 40] = 2.0
    assert abs(times[40] - times[10]) < AWAY_NS
    pairs = set(pairs_of(names, times, alike))
    assert (10, 150) in pairs
    assert (10, 40) not in pairs


def test_peer_pairs_grow_with_the_frames_not_their_square():
    rng = np.random.default_rng(0)
    counts = []
    for length in (200, 400):
        names, times = _frames(length)
        counts.append(len(pairs_of(names, times, rng.uniform(size=(2 * length, 2 * length)))))
    most = len(STEPS) + OWN_AGAIN + FROM_OTHER + 1
    assert counts[1] <= most * 800
    # Twice the frames give twice the pairs; pairs found from both sides vary by some percent.
    assert 1.9 < counts[1] / counts[0] < 2.2


def test_a_peer_over_its_time_limit_is_stopped_and_reported(tmp_path):
    row = Row("nothing", tmp_path, tmp_path)
    results = peers.run_peers(row, tmp_path / "work", 0.0)
    assert [result["peer"] for result in results] == list(peers.PEERS)
    assert all(result["stopped"] for result in results)
    assert "stopped after 0 minutes" in peers.lines_of(results[0], None)[0]


def test_a_failed_peer_is_reported_with_its_error(tmp_path):
    result = peers._child("database", Row("nothing", tmp_path / "missing", tmp_path), tmp_path, 60.0)
    assert result["exit"] != 0
    assert not result["stopped"]
    lines = peers.lines_of({"name": "nothing", "peer": "global", "limit_s": 60.0, **result}, None)
    assert "no model" in lines[0]
    assert "missing" in lines[0]


def test_a_stage_on_two_cameras_at_once_counts_once(monkeypatch):
    clock = iter(range(10))
    monkeypatch.setattr(ours.time, "monotonic", lambda: float(next(clock)))
    events = ["started", "started", "finished", "progress", "finished", "started", "finished"]
    lines = [f'{{"kind": "{kind}", "stage": "registration"}}' for kind in events]
    assert ours._wall_seconds(["no event", '{"exit": 0}', *lines]) == {"registration": 5.0}


def test_the_first_round_of_registration_is_reported_separately():
    each = [("registration", 0, 2.0), ("registration", 0, 3.0), ("extend", 1, 9.0), ("registration", 1, 0.5)]
    stages = [{"stage": stage, "round": number, "cpu_seconds": cpu} for stage, number, cpu in each]
    assert ours.registration_cpu_s(stages) == (5.0, 5.5)


def test_the_ratio_compares_map_and_registration():
    own = {"wall_seconds": {"keyframes": 9.0, "map": 3.0, "registration": 1.0}}
    total = {"registered": 9, "frames": 10, "ate_m": {"rmse": 0.01, "max": 0.02}}
    peer = {
        "peer": "global", "seconds": {"features": 4.0, "mapper": 8.0}, "peak_memory_mb": 1.0,
        "stopped": False, "models": [9, 1], "report": {"trajectories": {"total": total}},
    }  # fmt: skip
    text = "\n".join(peers.lines_of(peer, own))
    assert "9/10 frames, ATE 1.00 cm" in text
    assert "split into 2 models" in text
    assert "3.0 times as long" in text


def test_scaling_is_reported_relative_to_its_first_case():
    def case(seconds, cameras, wall_s):
        return {
            "scaling_seconds": seconds, "scaling_cameras": cameras, "wall_s": wall_s, "cpu_s": 2 * wall_s,
            "peak_memory_mb": 100.0,
            "wall_seconds": {"map": wall_s / 2}, "metrics": {"mapping": {"pairs": 10 * seconds}},
            "scaling_pixels": "640x480", "decoding_s": 1.0,
            "stage_seconds": {"map": wall_s - 3.0, "registration": 3.0, "report": 5.0},
        }  # fmt: skip

    lines = scaling.summary("length", [case(6, 3, 10.0), case(24, 3, 42.0), {}])
    whole = "whole job 4.20, its processor seconds 4.20, map and registration 4.20"
    assert f"{whole}, vision without decoding 5.00, pairs 4.00" in lines[-1]
    assert "did not run" in scaling.summary("size", [case(6, 3, 10.0)])[0]


def test_a_folder_is_a_row(tmp_path):
    (tmp_path / "groundtruth.txt").touch()
    assert row_of(tmp_path).truth == tmp_path / "groundtruth.txt"
    (tmp_path / "skeleton.bvh").touch()
    (tmp_path / "torso.mp4").touch()
    row = row_of(tmp_path)
    assert row.truth == tmp_path / "gt"
    assert row.reference == "torso"


def test_solving_compares_a_longer_capture_with_the_first():
    first = {
        "frames": 1000,
        "bones": 9,
        "cameras": 3,
        "seconds": 8.0,
        "motion_seconds": 5.0,
        "before_mb": 200,
        "peak_mb": 700,
    }
    longer = {**first, "frames": 10_000, "seconds": 84.0}
    assert solving.lines_of(first, first).endswith("peak 700 MB (200 before)")
    assert "10.5 times the seconds of the first, for 10.0 times its frames" in solving.lines_of(longer, first)
    assert "times" not in solving.lines_of({**longer, "bones": 15}, first)


def test_seeds_are_reported_with_their_spread():
    assert seeds.summary("walk", [0.01, 0.012, 0.008]) == (
        "walk: 1.00 cm on the average of 3 seeds, standard deviation 20%, from least to largest 40% of it"
    )


def test_keyframes_are_evaluated_after_one_similarity():
    scene_map = small_map()
    turn = so3_exp([0.1, 0.2, 0.3])
    truth = {name: np.tile(np.eye(4), (10, 1, 1)) for name in scene_map.cameras}
    for camera, frame, pose in zip(
        scene_map.keyframe_camera, scene_map.keyframe_frame, scene_map.map_from_cam, strict=True
    ):
        truth[camera][frame, :3, 3] = 2.0 * turn @ pose[:3, 3] + 1.0
    assert seeds.keyframe_errors_m(scene_map, truth).max() < 1e-9
    truth["torso"][0, 0, 3] += 1.0
    assert seeds.keyframe_errors_m(scene_map, truth).max() > 0.05


def _poses_with_noise(rng, count, sigma):
    """Return random true poses, noisy measurements of them in another gauge, and their covariances."""
    true = make_transform(so3_exp(rng.normal(0.0, 0.5, (count, 3))), rng.normal(0.0, 1.0, (count, 3)))
    gauge = Similarity(3.0, so3_exp(np.array([0.4, -0.2, 1.0])), np.array([1.0, 2.0, 3.0]))
    noise = rng.normal(0.0, sigma, (count, 6))
    step = make_transform(so3_exp(noise[:, :3]), noise[:, 3:])
    return gauge.apply_to_poses(true) @ step, true, np.tile(np.eye(6) * sigma**2, (count, 1, 1))


def test_correct_covariances_of_poses_give_one_in_any_gauge():
    estimates, true, stated = _poses_with_noise(np.random.default_rng(4), 400, 0.01)
    estimates[:8, :3, 3] += 0.5  # gross errors must not change the alignment
    found = poses.figures(poses.least_errors(estimates, true, stated), stated)
    for part in ("rotation", "centre", "pose"):
        # The median of 400 draws of chi-squared (3) has a sigma of 6 %; three sigmas and a margin.
        assert 0.8 < found[part] < 1.25
        assert found[f"{part}_inside"] > 0.9
    assert 1.0 < found["centre_sigma"] < 1.26  # the root of 3 over the median of chi-squared (3)
    wide = poses.figures(poses.least_errors(estimates, true, 4.0 * stated), 4.0 * stated)
    assert np.isclose(wide["centre"], found["centre"] / 4.0, rtol=0.02)
    assert wide["centre_inside"] > 0.97


def test_a_measured_truth_has_errors_of_its_own():
    """A tracked body carries the camera 2 degrees off, with another clock and with noise in every sample."""
    rng, sigma = np.random.default_rng(7), np.array([0.001] * 3 + [0.0005] * 3)

    def poses_at(time_s):
        phase = np.array([0.0, 1.0, 2.0])
        angle = 0.2 * np.sin(np.outer(time_s, [2.0, 1.7, 1.3]) + phase)
        return make_transform(so3_exp(angle), 0.3 * np.sin(np.outer(time_s, [1.1, 1.9, 1.5])))

    def noisy(exact, size):
        noise = rng.normal(0.0, 1.0, (len(exact), 6)) * size
        return exact @ make_transform(so3_exp(noise[:, :3]), noise[:, 3:])

    sample_s, frame_s = np.arange(0.0, 12.0, 0.01), 1.0 + np.arange(300) / 30.0
    mount = make_transform(so3_exp(np.radians([2.0, 0.0, -1.0])), np.array([0.02, 0.0, 0.01]))
    sample_ns = np.round(sample_s * 1e9).astype(np.int64)
    truth = TimedPoses(times_ns=sample_ns, world_from_cam=noisy(poses_at(sample_s), sigma) @ mount)
    times_ns = np.round(frame_s * 1e9).astype(np.int64)
    estimates = noisy(poses_at(frame_s + 0.008), 0.5 * sigma)
    stated = np.tile(np.diag((0.5 * sigma) ** 2), (300, 1, 1))
    true, _ = interpolate_truth(truth, times_ns)
    assert poses.figures(poses.least_errors(estimates, true, stated), stated)["pose_inside"] < 0.2
    measured = poses.MeasuredTruth.create(truth, times_ns)
    stated = stated + measured.noise
    found = poses.figures(poses.least_errors(estimates, true, stated, measured.twist), stated)
    assert 0.9 < found["pose_inside"] < 0.99


def test_a_long_capture_is_a_short_one_played_forwards_and_backwards(tmp_path):
    once, long_one = tmp_path / "once", tmp_path / "long"
    (once / "gt").mkdir(parents=True)
    frames = [np.full((48, 64), 60 + 30 * number, np.uint8) for number in range(4)]
    write_video(once / "torso.mp4", frames)
    for name in ("calib.json", "skeleton.bvh"):
        (once / name).write_text(name)
    truth = np.column_stack([np.arange(4) / 30.0, np.arange(4), np.zeros((4, 5)), np.ones(4)])
    np.savetxt(once / "gt" / "torso.tum", truth)
    replay = long.Replay(times=3, noise=1.0)
    assert replay.order(4) == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3]
    long.play(once, long_one, replay)
    played = np.loadtxt(long_one / "gt" / "torso.tum")
    assert played[:, 1].tolist() == replay.order(4)
    assert np.allclose(played[:, 0], np.arange(10) / 30.0, atol=1e-6)
    with av.open(str(long_one / "torso.mp4")) as opened:
        seen = [frame.to_ndarray(format="gray").mean() for frame in opened.decode(opened.streams.video[0])]
    assert len(seen) == 10
    assert np.argmax(seen[:4]) == 3
    # The second time the picture is brighter by a tenth and has other noise.
    assert 1.05 < seen[5] / seen[1] < 1.2


def _centres(count: int, start: int = 0) -> np.ndarray:
    t = 0.1 * np.arange(start, start + count)
    return np.stack([np.cos(t), np.sin(1.3 * t), 0.2 * t], axis=1)


def test_a_misplaced_camera_does_not_bend_the_alignment_of_the_bench():
    gauge = Similarity(0.3, so3_exp(np.array([0.2, -0.4, 1.0])), np.array([1.0, 2.0, 3.0]))
    matched = {
        name: (np.arange(60), gauge.apply(_centres(60, start)), _centres(60, start))
        for name, start in (("torso", 0), ("left_palm", 20), ("right_palm", 40))
    }
    frames, mine, true = matched["right_palm"]
    matched["right_palm"] = (frames, mine[0] + 3.0 * (mine - mine[0]), true)
    found = bare.robust_alignment(matched)
    np.testing.assert_allclose(found.scale * gauge.scale, 1.0, rtol=1e-9)


def test_misplaced_frames_are_reported_as_blocks():
    frames = np.array([0, 1, 2, 3, 10, 11, 12, 13])
    error_m = np.array([0.0, 0.2, 0.0, 0.3, 0.0, 0.0, 0.11, 0.05])
    blocks = bare.misplaced_blocks("torso", frames, error_m)
    assert [(block.first, block.last, block.frames) for block in blocks] == [(1, 3, 2), (12, 12, 1)]
    assert blocks[0].worst_cm == 30.0


def test_the_share_of_plain_surfaces_follows_the_surfaces():
    settings = {"cameras": ("torso",), "seconds": 1.0, "bare": ("ceiling",)}
    every = {**settings, "bare": bare_draw.SURFACES}
    assert bare_draw.bare_shares(SynthOptions.model_validate(settings)) == {"torso": 0.0}
    assert bare_draw.bare_shares(SynthOptions.model_validate(every)) == {"torso": 1.0}


def test_frames_of_a_violent_capture_are_compared_with_the_truth_and_with_the_job_without_sensors(tmp_path):
    """Frame 3 is lost without sensors and 20 cm off with them; the last frames end the clip."""
    times_s = np.arange(12) / 30.0
    places = np.stack([np.sin(3.0 * times_s), times_s, times_s**2], axis=1)
    tums = np.column_stack([times_s, places, np.tile([0.0, 0.0, 0.0, 1.0], (12, 1))])
    (tmp_path / "gt").mkdir()
    np.savetxt(tmp_path / "gt" / "torso.tum", tums)
    found = {}
    for name, lost, off_m in (("without", [3, 10, 11], 0.0), ("with", [10, 11], 0.2)):
        (tmp_path / name / "trajectories").mkdir(parents=True)
        solved = tums.copy()
        solved[3, 3] += off_m
        kept = [frame for frame in range(12) if frame not in lost]
        np.savetxt(tmp_path / name / "trajectories" / "torso.tum", solved[kept])
        status = ["LOST" if frame in lost else "REGISTERED" for frame in range(12)]
        if name == "with":
            status[3] = "INERTIAL"
        rows = [
            f"torso,{frame},{times_s[frame]:.9f},{times_s[frame]:.9f},{each},{'BLUR' * (each == 'LOST')},0,,,"
            for frame, each in enumerate(status)
        ]
        text = "# a comment\n" + "\n".join([",".join(COLUMNS), *rows]) + "\n"
        (tmp_path / name / "frames.csv").write_text(text, encoding="utf-8")
        metrics = {"frame": "map-0", "cameras": {"torso": {"frame": "map-0"}}}
        (tmp_path / name / "metrics.json").write_text(json.dumps(metrics), encoding="utf-8")
        found[name] = violent.frames_of(tmp_path / name, tmp_path / "gt")
    plain = violent.figures(found["without"], None)
    assert (plain["posed"], plain["short"], plain["long"], plain["off"]) == (9, 1, 2, 0)
    assert plain["rmse"] < 0.01
    used = violent.figures(found["with"], found["without"])
    assert (used["posed"], used["inertial"], used["short"], used["off"]) == (10, 1, 0, 1)
    assert (used["short_without"], used["of_them_posed"], used["gained"], used["common"]) == (1, 1, 1, 9)
    assert used["gained_rmse"] == used["max"] > 10.0


def test_poses_are_compared_with_the_mean_over_the_exposure_where_it_is_known(tmp_path):
    assert poses.shown_truth(tmp_path) == tmp_path
    (tmp_path / "exposure").mkdir()
    assert poses.shown_truth(tmp_path) == tmp_path / "exposure"
