"""The comparison of two versions: statistics on made-up runs, injected harm, resuming, inputs and sides."""

import json
import os
import subprocess
import sys
import threading
from dataclasses import replace

import av
import numpy as np
import pytest

from bodycap_batch.formats.tum import TimedPoses, write_tum
from bodycap_batch.model.camera import Camera
from bodycap_batch.model.geometry import make_transform, so3_exp
from tests.bench.paired import captures, compare, harm, measures, runs, sides, tables
from tests.bench.paired.captures import BenchCapture
from tests.bench.paired.command import Comparison
from tests.bench.paired.measures import Paths, truth_figures
from tests.bench.paired.perturb import Perturbation, make_input, perturbation, write_perturbed
from tests.bench.paired.runs import PictureFigures, RunRecord, RunSettings
from tests.bench.paired.sides import Side
from tests.bench.paired.statistics import LEAST_PAIRS, estimate, word_of
from tests.videos import textured_frame, write_video

FRAMES = 120


def _paths(seed: int, noise_m: float = 0.01) -> Paths:
    """Poses on a winding path of some metres; the delivered ones have noise, another scale and other axes."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 4, FRAMES)
    centres = np.stack([s, np.sin(2 * s), 0.3 * np.cos(3 * s)], axis=1)
    turns = so3_exp(np.stack([0.2 * s, 0.1 * np.sin(s), s], axis=1))
    true = make_transform(turns, centres)
    world = so3_exp(np.array([0.3, -0.2, 1.0]))
    noisy = centres + rng.normal(0, noise_m, centres.shape)
    mine = make_transform(world @ turns @ so3_exp(rng.normal(0, 0.002, (FRAMES, 3))), 0.4 * noisy @ world.T)
    return Paths(
        camera=np.full(FRAMES, "head"),
        times_ns=np.arange(FRAMES) * 33_333_333,
        mine=mine,
        true=true,
    )


def _record(capture: str, seed: int, paths: Paths | None, **values) -> RunRecord:
    figures = None if paths is None else truth_figures(paths)
    defaults = {
        "exit": 0,
        "cpu_s": 30.0,
        "memory_mb": 300.0,
        "frames": FRAMES,
        "posed": FRAMES,
        "models": 1,
        "digest": f"{capture}-{seed}",
        "grade": "good",
        "has_truth": paths is not None,
        "truth": figures,
    }
    return RunRecord(capture=capture, seed=seed, side="a", **{**defaults, **values})


def _runs(count: int = 4, seeds: int = 3) -> dict:
    """Runs of captures with a truth, and of one without."""
    out = {}
    for index in range(count):
        for seed in range(seeds):
            paths = _paths(100 * index + seed, 0.004 * (1 + index))
            out[f"c{index}", seed] = (_record(f"c{index}", seed, paths), paths)
    for seed in range(seeds):
        pictures = PictureFigures(right=100 - seed, wrong=0, unmeasurable=20 + seed)
        out["clip", seed] = (_record("clip", seed, None, pictures=pictures), None)
    return out


# statistics


def test_a_difference_that_all_captures_have_is_found_with_its_sign():
    rng = np.random.default_rng(0)
    values = {f"c{index}": 2.0 + rng.normal(0, 0.5, 3) for index in range(8)}
    found = estimate(values)
    assert found is not None
    assert found.low < 2.0 < found.high
    assert word_of(found, 1) == "better"
    assert word_of(found, -1) == "worse"


def test_chance_alone_is_no_difference_in_nearly_all_comparisons():
    rng = np.random.default_rng(1)
    words = []
    for _ in range(60):
        shift = rng.normal(0, 1.0, 8)
        words.append(word_of(estimate({str(i): shift[i] + rng.normal(0, 1, 3) for i in range(8)}), 1))
    # An interval of 99 % of eight captures misses somewhat more often than in 1 % of the cases.
    assert words.count("no difference") >= 55


def test_perturbations_of_one_capture_do_not_replace_captures():
    """A capture with a large difference in all its perturbations decides nothing about the others."""
    values = {"one": [5.0] * 30, **{str(index): [0.0, 0.1, -0.1] for index in range(4)}}
    assert word_of(estimate(values), 1) == "no difference"
    assert word_of(estimate({"one": [5.0, 5.1, 4.9] * 10}), 1) == "better"


def test_few_pairs_decide_nothing_unless_all_are_equal():
    assert word_of(estimate({"a": [1.0] * (LEAST_PAIRS - 1)}), 1) == "too few"
    assert word_of(estimate({"a": [0.0]}), 1) == "no difference"
    assert word_of(estimate({"a": [1.0] * 3, "b": [1.1] * 3}), 1) == "better"
    assert word_of(estimate({"a": [1e-9] * 9}), 1) == "no difference"
    assert estimate({"a": []}) is None


def test_the_conclusion_names_what_is_worse_and_what_is_better():
    def said(*words):
        columns = (compare.RIGHT, compare.WRONG, compare.ATE)
        outcomes = [
            compare.Outcome(column=c, found=None, word=w) for c, w in zip(columns, words, strict=True)
        ]
        return compare.conclusion(outcomes, [], "b", 4)

    assert (
        said("worse", "better", "no difference")
        == "B is worse in: right frames; B is better in: wrong frames"
    )
    assert said("no difference", "too few", "no difference") == "not decided: too few pairs"
    assert "after 4 seeds: the simpler side wins, which is b" in said(*["no difference"] * 3)


# injected harm


def test_injected_harm_is_found_and_other_perturbations_are_no_harm():
    results = {each.name.split(",")[0]: each for each in harm.check(_runs())}
    assert len(results) == 4
    for each in results.values():
        assert each.is_found, tables.harm_lines([each])


def test_injected_harm_names_the_columns_that_it_changes():
    lost, larger, folded, _ = harm.check(_runs())
    words = {each.column.name.split(",")[0]: each.word for each in lost.outcomes}
    assert words["posed frames"] == "worse"
    assert words["ATE of common frames"] == "no difference"
    ratio = next(each.found for each in larger.outcomes if each.column is compare.ATE)
    assert np.exp(ratio.mean) == pytest.approx(1.1, abs=1e-6)
    assert [(each.capture, each.seed, each.side) for each in folded.folds] == [("c0", 0, "B")]
    # 40 % of the frames of a run are turned; those near the pivot stay near.
    assert folded.folds[0].points == pytest.approx(40.0, abs=1.0)


def test_a_comparison_without_any_harm_is_equal():
    own = _runs()
    pairs = compare.pair_up(
        {key: (run[0], run[0]) for key, run in own.items()}, lambda run: own[run.capture, run.seed][1]
    )
    outcomes = compare.compare(pairs)
    assert {each.word for each in outcomes if each.column.is_outcome} == {"equal"}
    assert "the simpler side wins, which is b" in compare.conclusion(outcomes, [], "b", 3)
    slower = [replace(pair, b=replace(pair.b, cpu_s=40.0)) for pair in pairs]
    words = {each.column.name: each.word for each in compare.compare(slower)}
    assert words["CPU seconds, ratio"] == "worse"
    assert "equal byte for byte" in compare.conclusion(compare.compare(slower), [], "b", 3)
    assert not compare.folds(pairs)
    assert "equal" in "\n".join(tables.pair_table(pairs))


def test_margins_hold_for_a_small_loss_and_fail_for_a_large_one():
    own = _runs(8)
    for share, word in ((0, "holds"), (6, "fails")):
        changed = {
            key: (record, replace(record, truth=replace(record.truth, right=FRAMES - share)))
            for key, (record, _) in own.items()
            if record.truth
        }
        pairs = compare.pair_up(changed, lambda run: None)
        assert compare.margins(pairs)[0][2] == word


def test_a_hard_capture_has_a_floor_and_does_not_count_in_the_margins():
    name, floor = next(iter(compare.FLOORS.items()))
    few = replace(_record(name, 0, _paths(0)).truth, right=int(floor.right * FRAMES) - 1, wrong=0)
    run = _record(name, 0, _paths(0), truth=few)
    assert [each[3] for each in compare.floors([run])] == ["fails"]
    assert [each[3] for each in compare.floors([replace(run, truth=replace(few, right=FRAMES))])] == ["holds"]
    pairs = [compare.Pair(a=replace(run, truth=replace(few, right=FRAMES)), b=run)]
    assert compare.margins(pairs)[0][1] is None


def test_a_fold_counts_only_if_the_other_side_never_has_it():
    folded = PictureFigures(right=60, wrong=60, unmeasurable=0)
    sound = PictureFigures(right=FRAMES, wrong=0, unmeasurable=0)
    runs_a = [_record("clip", seed, None, pictures=sound) for seed in range(3)]
    runs_b = [replace(runs_a[0], pictures=folded), *runs_a[1:]]
    pairs = [compare.Pair(a=a, b=b) for a, b in zip(runs_a, runs_b, strict=True)]
    assert [(each.seed, each.side, each.points) for each in compare.folds(pairs)] == [(0, "B", 50.0)]
    runs_a[2] = replace(runs_a[2], pictures=folded)
    assert not compare.folds([compare.Pair(a=a, b=b) for a, b in zip(runs_a, runs_b, strict=True)])
    # A capture that is often folded on both sides decides by its mean.
    poor = replace(folded, wrong=20)
    pairs = [compare.Pair(a=replace(a, pictures=poor), b=replace(a, pictures=folded)) for a in runs_a]
    assert not compare.folds(pairs)


# measures


def test_rotations_are_compared_under_the_rotation_of_most_frames():
    paths = _paths(0)
    turned = paths.mine.copy()
    turned[80:, :3, :3] = so3_exp(np.array([0, 0, np.pi / 2])) @ turned[80:, :3, :3]
    errors = measures.rotation_errors_deg(turned[:, :3, :3], paths.true[:, :3, :3], is_measured=False)
    # The noise of 0.002 rad in three axes is 0.2 degrees.
    assert errors[:80].max() < 1.0
    assert errors[80:] == pytest.approx(90.0, abs=1.0)


def test_a_constant_rotation_of_the_camera_in_the_tracked_body_is_no_error():
    paths = _paths(0)
    mine = paths.mine[:, :3, :3] @ so3_exp(np.array([0.2, -0.1, 0.1]))
    measured = measures.rotation_errors_deg(mine, paths.true[:, :3, :3], is_measured=True)
    computed = measures.rotation_errors_deg(mine, paths.true[:, :3, :3], is_measured=False)
    assert measured.max() < 1.0
    assert computed.max() > 5.0


def test_frames_are_right_or_wrong_under_the_alignment_of_the_majority():
    paths = _paths(0)
    figures = truth_figures(paths)
    assert (figures.right, figures.wrong) == (FRAMES, 0)
    assert figures.ate_m == pytest.approx(0.01 * np.sqrt(3), rel=0.2)
    mine = paths.mine.copy()
    mine[90:, :3, 3] += 0.4 * 3.0
    moved = truth_figures(replace(paths, mine=mine))
    assert (moved.right, moved.wrong) == (90, 30)


def test_errors_are_compared_on_the_frames_that_both_have():
    a = _paths(0)
    b = a.chosen(np.arange(20, FRAMES))
    mine, other = measures.ates_of_common(a, b)
    assert mine == pytest.approx(other)
    assert measures.ates_of_common(a.chosen(np.arange(20)), b) is None
    assert measures.ates_of_common(replace(a, camera=np.full(FRAMES, "torso")), b) is None


def test_a_head_that_hardly_moves_needs_more_than_ten_centimetres():
    """A path of 16 cm, at which every fifth pose is 5 cm off."""
    paths = _paths(0)
    small = {name: getattr(paths, name).copy() for name in ("mine", "true")}
    for poses in small.values():
        poses[:, :3, 3] *= 0.16 / np.linalg.norm(np.ptp(paths.true[:, :3, 3], axis=0))
    small["mine"][::5, 2, 3] += 0.4 * 0.05
    assert truth_figures(replace(paths, **small)).wrong == FRAMES // 5


def test_a_verdict_is_wrong_if_it_trusts_wrong_frames_or_distrusts_right_ones():
    assert measures.wrong_verdict("good", 100, 80, 20) == "trusted"
    assert measures.wrong_verdict("usable with care", 100, 99, 1) == ""
    assert measures.wrong_verdict("poor", 100, 95, 1) == "distrusted"
    assert measures.wrong_verdict("poor", 100, 50, 0) == ""


def test_the_angles_of_a_lens_are_those_of_a_pinhole():
    lens = Camera(model="PINHOLE", width_px=640, height_px=480, params=[400.0, 400.0, 320.0, 240.0])
    expected = np.rad2deg(np.arctan([128 / 400, 256 / 400]))
    assert measures.lens_angles_deg(lens) == pytest.approx(expected)


def test_a_digest_of_results_ignores_comments_but_no_pose(tmp_path):
    digests = []
    for comment, shift in (("a", 0.0), ("b", 0.0), ("a", 1e-6)):
        paths = _paths(0)
        paths.mine[0, 0, 3] += shift
        poses = TimedPoses(times_ns=paths.times_ns, world_from_cam=paths.mine)
        folder = tmp_path / f"{comment}{shift}"
        (folder / "trajectories").mkdir(parents=True)
        write_tum(folder / "trajectories" / "torso.tum", poses, [comment])
        digests.append(measures.digest_of_results(folder))
    assert digests[0] == digests[1] != digests[2]


def test_paths_and_records_survive_their_files(tmp_path):
    paths = replace(_paths(0), is_measured=True)
    paths.save(tmp_path / runs.PATHS)
    loaded = Paths.load(tmp_path / runs.PATHS)
    assert loaded.is_measured
    assert (loaded.mine == paths.mine).all()
    record = _record(
        "c", 1, paths, pictures=PictureFigures(right=1, wrong=2, unmeasurable=3), lens={"0.2": 0.1}
    )
    record.save(tmp_path)
    assert RunRecord.load(tmp_path) == record
    values = json.loads((tmp_path / runs.RECORD).read_text())
    (tmp_path / runs.RECORD).write_text(json.dumps({**values, "format": 0}))
    assert RunRecord.load(tmp_path) is None


# running


@pytest.fixture
def capture(tmp_path) -> BenchCapture:
    folder = tmp_path / "clip"
    write_video(folder / "head.mp4", [textured_frame(index) for index in range(12)])
    return BenchCapture(name="clip", source=folder)


def test_a_stored_record_is_not_run_again(tmp_path, capture, monkeypatch):
    calls = []

    def job(side, capture, job, folder, settings):
        calls.append((side.name, job))
        return {"exit": 3, "error": "no frames", "seconds": 1.0, "cpu_s": 0.5}

    monkeypatch.setattr(runs, "_run_job", job)
    side = Side(name="a", folder=tmp_path, version="1")
    settings = RunSettings(work=tmp_path / "work")
    first = runs.run(side, capture, 0, settings)
    assert (first.exit, first.error, first.frames, first.right) == (3, "no frames", 12, 0)
    assert runs.run(side, capture, 0, settings) == first
    assert len(calls) == 1
    # A record that was cut off is no record.
    folder = runs.folder_of("a", "clip", 0, settings.work)
    (folder / runs.RECORD).rename(folder / f".1-{runs.RECORD}")
    runs.run(side, capture, 0, settings)
    runs.run(replace(side, name="b"), capture, 0, settings)
    assert [name for name, _ in calls] == ["a", "a", "b"]


def test_pictures_are_measured_once_for_equal_outputs_and_again_for_another_measure(
    tmp_path, capture, monkeypatch
):
    measured, measure = [], tmp_path / "evaluate"
    measure.mkdir()
    (measure / "a.py").write_text("1")

    def pictures(out, job):
        measured.append(out)
        return PictureFigures(right=10, wrong=0, unmeasurable=2)

    def job(side, capture, job, folder, settings):
        (folder / "out").mkdir()
        for name in runs._NEEDED:
            (folder / "out" / name).write_text("{}")
        return {"exit": 0}

    monkeypatch.setattr(runs, "_MEASURE", measure)
    monkeypatch.setattr(runs, "_run_job", job)
    monkeypatch.setattr(runs, "_pictures", pictures)
    monkeypatch.setattr(
        runs, "_measure", lambda side, capture, folder: {"posed": 12, "frames": 12, "digest": side.version}
    )
    settings = RunSettings(work=tmp_path / "work")
    a, b, c = (
        Side(name=name, folder=tmp_path, version=version)
        for name, version in (("a", "1"), ("b", "1"), ("c", "2"))
    )
    assert [runs.run(side, capture, 0, settings).right for side in (a, b, c, a)] == [10] * 4
    assert len(measured) == 2
    (measure / "a.py").write_text("2")
    assert len([runs.run(side, capture, 0, settings) for side in (a, b)]) == len(measured) == 2
    again = replace(settings, pictures_again=True)
    assert len({runs.run(side, capture, 0, again).measure for side in (a, b, c)}) == 1
    assert len(measured) == 4


def test_a_job_at_its_time_limit_is_stopped_and_is_a_result():
    sleeping = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], start_new_session=True)
    code, _ = runs._wait(sleeping, 0.3)
    assert code is None
    assert sleeping.returncode != 0
    busy = subprocess.Popen([sys.executable, "-c", "sum(range(10**7))"], start_new_session=True)
    code, cpu_s = runs._wait(busy, 60.0)
    assert code == 0
    assert cpu_s > 0.05


def test_a_job_runs_with_the_package_and_the_switches_of_its_side(tmp_path, capture):
    package = tmp_path / "side" / "bodycap_batch" / "cli"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").touch()
    text = "import os, sys\ndef main():\n    print(os.environ.get('BODYCAP_WITHOUT')); sys.exit(4)\n"
    (package / "__init__.py").write_text(text)
    side = Side(name="a-x", folder=tmp_path / "side", version="1", without=("repair", "rigs"))
    record = runs.run(side, capture, 0, RunSettings(work=tmp_path / "work"))
    assert record.exit == 4
    folder = runs.folder_of("a-x", "clip", 0, tmp_path / "work")
    assert (folder / "stdout.txt").read_text().strip() == "repair,rigs"


def test_the_counts_of_all_stages_are_added_and_absent_counts_are_unknown():
    assert runs.acted({"stages": [{"stage": "map"}]}) is None
    stages = [{"acted": {"repair": 2, "rigs": 0}}, {"acted": {"repair": 1}}, {}]
    assert runs.acted({"stages": stages}) == {"repair": 3, "rigs": 0}


def _compared(a: Side, b: Side, acted: dict | None = None, end: float | None = None, work=None):
    order = []

    def job(side, capture, seed, settings):
        order.append((capture.name, seed, side.name))
        return replace(_record(capture.name, seed, None, acted=acted), side=side.name)

    comparison = Comparison(a, b, RunSettings(work=work), end, job)
    comparison.run_all([BenchCapture(name=name, source=None) for name in ("x", "y")], 2, 1)
    return comparison, order


def test_jobs_alternate_between_the_sides_and_seeds_come_last(tmp_path):
    a, b = (Side(name=name, folder=tmp_path, version=name) for name in "ab")
    comparison, order = _compared(a, b)
    keys = [("x", 0), ("y", 0), ("x", 1), ("y", 1)]
    assert order == [(*key, name) for key in keys for name in "ab"]
    assert sorted(comparison.runs) == sorted(keys)


def test_no_job_starts_when_the_time_is_over_but_stored_runs_count(tmp_path):
    a, b = (Side(name=name, folder=tmp_path, version=name) for name in "ab")
    for side in (a, b):
        folder = runs.folder_of(side.name, "x", 1, tmp_path)
        folder.mkdir(parents=True)
        replace(_record("x", 1, None), side=side.name).save(folder)
    comparison, order = _compared(a, b, end=0.0, work=tmp_path)
    assert not order
    assert comparison.open == 3
    assert list(comparison.runs) == [("x", 1)]


def test_a_pair_that_cannot_be_measured_is_reported_and_the_others_run(tmp_path, capsys):
    def job(side, capture, seed, settings):
        if (capture.name, side.name) == ("x", "b"):
            raise ValueError("no such map")
        return replace(_record(capture.name, seed, None), side=side.name)

    a, b = (Side(name=name, folder=tmp_path, version=name) for name in "ab")
    comparison = Comparison(a, b, RunSettings(work=tmp_path), None, job)
    comparison.run_all([BenchCapture(name=name, source=tmp_path) for name in ("x", "y")], 1, 1)
    assert list(comparison.runs) == [("y", 0)]
    assert comparison.failed == 1
    assert "no such map" in capsys.readouterr().out


def test_a_stopped_comparison_stops_its_job_and_leaves_no_record(tmp_path, capture, monkeypatch):
    monkeypatch.setattr(runs, "BODYCAP", (sys.executable, "-c", "import time; time.sleep(60)"))
    monkeypatch.setattr(runs, "stopping", threading.Event())
    side = Side(name="a", folder=tmp_path, version="1")
    timer = threading.Timer(0.5, runs.stopping.set)
    timer.start()
    with pytest.raises(InterruptedError):
        runs.run(side, capture, 0, RunSettings(work=tmp_path / "work"))
    assert RunRecord.load(runs.folder_of("a", "clip", 0, tmp_path / "work")) is None


def test_a_record_of_other_videos_is_made_again(tmp_path, capture, monkeypatch):
    monkeypatch.setattr(runs, "_run_job", lambda *_: {"exit": 3})
    side, settings = Side(name="a", folder=tmp_path, version="1"), RunSettings(work=tmp_path / "work")
    assert runs.run(side, capture, 0, settings).frames == 12
    write_video(capture.source / "head.mp4", [textured_frame(index) for index in range(9)])
    assert runs.run(side, capture, 0, settings).frames == 9


def test_a_capture_on_which_the_mechanism_never_acts_is_not_compared(tmp_path):
    off = Side(name="a-repair", folder=tmp_path, version="a", without=("repair",))
    on = Side(name="a", folder=tmp_path, version="a")
    for sides_of in ((on, off), (off, on)):
        comparison, order = _compared(*sides_of, acted={"rigs": 2})
        assert comparison.idle == {"x", "y"}
        assert [name for _, _, name in order] == ["a", "a"]
    # It acts, or nobody knows: both run.
    for acted in ({"repair": 1, "rigs": 2}, None):
        comparison, order = _compared(on, off, acted=acted)
        assert not comparison.idle
        assert len(order) == 8


# inputs


def test_a_later_start_keeps_the_times_and_the_pictures_of_the_other_frames(tmp_path, capture):
    job, videos = make_input(replace(capture, name="new"), 1, tmp_path / "work")
    assert job == videos
    times = (videos / "head.timestamps.txt").read_text().split()
    assert [float(each) for each in times] == pytest.approx(np.arange(1, 12) / 30, abs=1e-6)
    with av.open(str(capture.source / "head.mp4")) as old, av.open(str(videos / "head.mp4")) as new:
        before = [frame.to_ndarray(format="gray") for frame in old.decode(video=0)][1:]
        after = [frame.to_ndarray(format="gray") for frame in new.decode(video=0)]
    assert len(after) == 11
    for one, other in zip(before, after, strict=True):
        # Successive frames differ by 4 grey levels.
        assert np.abs(one.astype(int) - other).mean() < 1.5


def test_noise_is_of_one_grey_level_and_follows_the_seed(tmp_path, capture):
    source = capture.source / "head.mp4"
    pictures = []
    for name, noise in (("none", 0), ("noise", 1), ("again", 1)):
        write_perturbed(source, tmp_path / f"{name}.mp4", Perturbation(noise=noise, crf=0), 2)
        with av.open(str(tmp_path / f"{name}.mp4")) as video:
            pictures.append(np.stack([each.to_ndarray()[:48] for each in video.decode(video=0)]))
    difference = pictures[1].astype(int) - pictures[0]
    assert set(np.unique(difference)) == {-1, 0, 1}
    assert (pictures[1] == pictures[2]).all()


def test_seeds_are_unlike_and_the_first_one_is_the_input_as_it_is(tmp_path, capture):
    assert perturbation(0) is None
    assert len({perturbation(seed) for seed in range(12)}) == 12
    assert make_input(capture, 0, tmp_path) == (capture.source, capture.source)
    assert not (tmp_path / "inputs").exists()


@pytest.mark.parametrize("seed", range(1, 8))
def test_every_seed_gives_other_pictures_to_the_job(tmp_path, capture, seed):
    _, videos = make_input(capture, seed, tmp_path / "work")
    given = (videos / "head.mp4").read_bytes()
    assert given != (capture.source / "head.mp4").read_bytes()
    # It is written once, also for the capture without its lens.
    (capture.source / "calib.json").write_text("{}")
    before = (videos / "head.mp4").resolve()
    _, blind = make_input(replace(capture, name="other", has_lens=False), seed, tmp_path / "work")
    assert (blind / "head.mp4").resolve() == before
    assert len(list((tmp_path / "work" / "videos").iterdir())) == 1


def test_files_beside_a_video_follow_its_start(tmp_path, capture):
    (capture.source / "head.timestamps.txt").write_text(
        "# s\n" + "".join(f"{5 + i / 30}\n" for i in range(12))
    )
    (capture.source / "head.imu.csv").write_text("t_s,gx\n0.0,1\n")
    _, videos = make_input(capture, 5, tmp_path / "work")
    times = [float(each) for each in (videos / "head.timestamps.txt").read_text().split()]
    assert times[0] == 5 + 2 / 30
    assert len(times) == 10
    # The samples are on the clock of the camera, which stays.
    assert (videos / "head.imu.csv").read_text() == "t_s,gx\n0.0,1\n"


def test_a_withheld_lens_leaves_the_clocks(tmp_path, capture):
    calibration = {"model": "PINHOLE", "offsets_s": {"head": 0.5}, "rolling_shutter_s": 0.01}
    (capture.source / "calib.json").write_text(json.dumps(calibration))
    [blind] = captures.without_lens([capture])
    job, _ = make_input(blind, 0, tmp_path / "work")
    assert blind.name == "clip_no_lens"
    assert not (job / "calib.json").exists()
    text = (job / "job.yaml").read_text()
    assert "offset_s: 0.5" in text
    assert "rolling_shutter_s: 0.01" in text
    assert "PINHOLE" not in text


def test_videos_of_other_folders_keep_their_place_in_a_job_file(tmp_path, capture):
    (capture.source / "both.yaml").write_text(
        "capture:\n  cameras:\n    - {name: a, video: head.mp4}\n    - {name: b, video: ../other/head.mp4}\n"
    )
    found = captures.folder_captures(tmp_path, has_body=False)
    assert [each.name for each in found] == ["clip", "clip:both"]
    job, _ = make_input(found[1], 1, tmp_path / "work")
    assert f"video: {tmp_path / 'other' / 'head.mp4'}" in job.read_text()
    assert "video: head.mp4" in job.read_text()


def test_absent_folders_are_said(tmp_path):
    said = []
    assert captures.all_captures(tmp_path / "no", None, said.append, data=tmp_path / "none") == []
    assert len(said) == 3
    assert all("skipped" in line for line in said)


# sides


@pytest.fixture
def repository(tmp_path):
    folder = tmp_path / "repository"
    (folder / "bodycap_batch").mkdir(parents=True)
    (folder / "bodycap_batch" / "a.py").write_text("a = 1\n")
    for arguments in (["init", "-q", "-b", "a-branch"], ["add", "."], ["commit", "-q", "-m", "first"]):
        subprocess.run(["git", "-C", folder, *arguments], check=True, env={**os.environ, **_AUTHOR})
    return folder


_AUTHOR = {
    f"GIT_{who}_{what}": "x@example.org" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")
}


def test_a_side_is_a_commit_with_mechanisms_left_out(tmp_path, repository):
    side = sides.make_side("a-branch-rigs,repair", tmp_path / "work", repository)
    assert side.without == ("repair", "rigs")
    assert (side.folder / "bodycap_batch" / "a.py").exists()
    assert side.environment(1)["BODYCAP_WITHOUT"] == "repair,rigs"
    assert side.environment(1)["PYTHONPATH"] == str(side.folder)
    full = sides.make_side("a-branch", tmp_path / "work", repository)
    assert "BODYCAP_WITHOUT" not in full.environment(1)
    assert full.name != side.name
    assert sides.left_out(full, side) == (full, side, ("repair", "rigs"))
    assert sides.simpler(full, side) is side
    names = ",".join(f"mechanism{number}" for number in range(40))
    many = sides.make_side(f"a-branch-{names}", tmp_path / "work", repository)
    assert len(many.without) == 40
    assert len(many.name) < 60
    assert sides.simpler(many, side) is many
    with pytest.raises(SystemExit, match="no such commit"):
        sides.make_side("nothing", tmp_path / "work", repository)


def test_a_name_that_the_version_does_not_know_is_refused(tmp_path):
    package = tmp_path / "bodycap_batch" / "core"
    package.mkdir(parents=True)
    for file in (package.parent / "__init__.py", package / "__init__.py"):
        file.touch()
    text = "import os\ndef switched_off():\n    assert os.environ['BODYCAP_WITHOUT'] == 'rigs', 'unknown'\n"
    (package / "mechanisms.py").write_text(text)
    sides.check_switches(Side(name="a", folder=tmp_path, version="1", without=("rigs",)))
    with pytest.raises(SystemExit, match="unknown"):
        sides.check_switches(Side(name="a", folder=tmp_path, version="1", without=("rigz",)))


def test_a_changed_working_tree_is_a_side_of_its_own(tmp_path, repository):
    clean = sides.make_side(".", tmp_path / "work", repository)
    (repository / "bodycap_batch" / "a.py").write_text("a = 1\nb = 2\n")
    changed = sides.make_side(".", tmp_path / "work", repository)
    assert changed.name != clean.name
    (repository / "bodycap_batch" / "a.py").write_text("c = 3\n")
    assert (changed.folder / "bodycap_batch" / "a.py").read_text() == "a = 1\nb = 2\n"
    assert sides.left_out(clean, changed) is None
    assert sides.simpler(clean, changed) is clean


def test_the_table_of_runs_has_sums_and_errors():
    failed = RunRecord(
        capture="bad", seed=0, side="a", exit=None, error="stopped after 20 minutes", frames=FRAMES
    )
    text = "\n".join(tables.run_table([_record("c", 0, _paths(0)), failed]))
    assert f"{FRAMES} of {2 * FRAMES} frames right (50.0%; mean over captures 50.0%)" in text
    assert "bad: stopped after 20 minutes" in text
