"""`Result` reads back what the export stage writes, and the scripts of the page about Python run."""

from __future__ import annotations

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import bodycap_batch
from bodycap_batch import BodyMotion, Result, api
from bodycap_batch.core.errors import JobError
from bodycap_batch.export import ExportInputs
from bodycap_batch.export.target_frames import trajectories_in_target_frames
from bodycap_batch.formats.frame_table import read_frame_table
from bodycap_batch.formats.joint_table import read_joint_table
from bodycap_batch.model.geometry import rotation_angle_rad
from tests.stages.test_export import inputs_of, run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "python.md"
NUMBER = 5e-10
"""Half a unit of the last of nine decimals."""


def exported(folder: Path, **options: Any) -> tuple[ExportInputs, Result]:
    inputs = inputs_of(folder)
    run(inputs, **options)
    return inputs, Result(inputs.out_dir)


def scripts() -> list[str]:
    """The Python blocks of the page."""
    return [part.split("```")[0] for part in PAGE.read_text(encoding="utf-8").split("```python\n")[1:]]


def test_the_paths_are_those_of_the_cameras(tmp_path: Path) -> None:
    inputs, result = exported(tmp_path)
    paths = result.trajectories()
    assert list(paths) == [path.camera for path in inputs.trajectories]
    for truth in trajectories_in_target_frames(inputs):
        path = paths[truth.camera]
        assert path.frame_of_reference == "world"
        assert path.camera == truth.camera
        assert path.status == truth.status
        assert not path.localised.all()
        np.testing.assert_array_equal(path.localised, truth.localised)
        np.testing.assert_array_equal(path.frames.times_ns, truth.times_ns)
        np.testing.assert_array_equal(path.frames.frame_numbers, truth.frame_numbers)
        np.testing.assert_array_equal(path.frames.inliers, truth.inliers)
        np.testing.assert_array_equal(path.frames.map_numbers, np.where(truth.localised, 0, -1))
        np.testing.assert_allclose(path.centres, truth.gauge_from_cam[:, :3, 3], atol=2 * NUMBER)
        turned = path.rotations[path.localised] @ truth.gauge_from_cam[path.localised, :3, :3].swapaxes(1, 2)
        assert rotation_angle_rad(turned).max() < 1e-7
        assert np.isnan(path.world_from_cam[~path.localised]).all()


def test_the_sigmas_are_those_of_the_covariances(tmp_path: Path) -> None:
    inputs, result = exported(tmp_path)
    for truth in trajectories_in_target_frames(inputs):
        frames, posed = result.frames()[truth.camera], truth.localised
        variance = np.diagonal(truth.covariance, axis1=1, axis2=2)
        # The table has six decimals.
        np.testing.assert_allclose(
            frames.sigma_position[posed], np.sqrt(variance[posed, 3:].mean(axis=1)), atol=5e-7
        )
        np.testing.assert_allclose(
            frames.sigma_rotation_deg[posed], np.degrees(np.sqrt(variance[posed, :3].mean(axis=1))), atol=5e-7
        )
        assert np.isnan(frames.sigma_position[~posed]).all()
        assert (frames.sigma_position[posed] > 0).all()


def test_a_table_of_an_earlier_version_has_no_sigmas_and_maps(tmp_path: Path) -> None:
    _, result = exported(tmp_path)
    table = result.folder / "frames.csv"
    lines = table.read_text(encoding="utf-8").splitlines()
    table.write_text("\n".join(line.rsplit(",", 3)[0] for line in lines), encoding="utf-8")
    frames = result.frames()["torso"]
    assert np.isnan(frames.sigma_position).all()
    assert (frames.map_numbers == -1).all()
    assert np.isfinite(frames.error_px[frames.localised]).all()


@pytest.mark.parametrize("table", ["csv", "npz"])
def test_the_motion_is_that_of_the_body(tmp_path: Path, table: str) -> None:
    inputs, result = exported(tmp_path, formats=["tum", table])
    assert inputs.merge is not None
    body, motion = result.motion(), inputs.merge.motion
    world = motion.world_from_joint()
    kept = [motion.skeleton.joints.index(name) for name in body.joints]
    # The table has six decimals.
    np.testing.assert_allclose(body.positions_m, world[:, kept][..., :3, 3], atol=6e-7)
    assert rotation_angle_rad(body.rotations @ world[:, kept][..., :3, :3].swapaxes(2, 3)).max() < 1e-5
    np.testing.assert_array_equal(body.times_ns, motion.times_ns())
    np.testing.assert_array_equal(body.observed, motion.observed[:, kept])
    np.testing.assert_allclose(body.sigma_m, inputs.merge.joint_sigma_m()[:, kept], atol=5e-7)
    assert body.joints[body.index("LeftHand")] == "LeftHand"
    with pytest.raises(JobError, match="no joint 'Tail'") as caught:
        body.index("Tail")
    assert "LeftHand" in (caught.value.hint or "")


def test_the_clocks_relate_the_times_of_the_frames(tmp_path: Path) -> None:
    inputs = inputs_of(tmp_path)
    late = replace(inputs.clocks["left_palm"], offset_s=inputs.clocks["left_palm"].offset_s + 0.5)
    inputs = replace(inputs, clocks={**inputs.clocks, "left_palm": late}, reference_camera="torso")
    run(inputs)
    result = Result(inputs.out_dir)
    clocks, frames = result.clocks(), result.frames()
    shift = {name: float((table.common_times_ns - table.times_ns)[0]) / 1e9 for name, table in frames.items()}
    for name, clock in clocks.items():
        assert clock.offset_s == pytest.approx(shift[name] - shift["torso"])
    assert clocks["left_palm"].offset_s == pytest.approx(0.5)


def test_every_file_has_a_kind(tmp_path: Path) -> None:
    _, result = exported(tmp_path)
    files = result.files()
    named = {path for paths in files.values() for path in paths}
    assert named == {path for path in result.folder.rglob("*") if path.is_file()}
    assert sum(map(len, files.values())) == len(named)
    assert result.folder / "motion.bvh" in files["motion"]


def test_without_a_body_there_is_no_motion(tmp_path: Path) -> None:
    inputs = inputs_of(tmp_path, with_body=False)
    run(inputs)
    result = Result(inputs.out_dir)
    assert {path.frame_of_reference for path in result.trajectories().values()} == {"map-0"}
    with pytest.raises(JobError, match="no table of the joints"):
        result.motion()


def test_missing_and_mixed_files_are_named(tmp_path: Path) -> None:
    _, result = exported(tmp_path)
    with pytest.raises(JobError, match="no such file") as caught:
        result.verdict()
    assert str(caught.value.path).endswith("verdict.json")
    table = result.folder / "trajectories" / "torso.tum"
    table.write_text("\n".join(table.read_text(encoding="utf-8").splitlines()[:-1]), encoding="utf-8")
    with pytest.raises(JobError, match="do not have the same frames"):
        result.trajectories()
    (result.folder / "frames.csv").unlink()
    with pytest.raises(JobError, match="no table of the frames") as caught:
        result.frames()
    assert "export.formats" in (caught.value.hint or "")
    shutil.move(result.folder, tmp_path / "job" / "partial")
    with pytest.raises(JobError, match="no results") as caught:
        Result(tmp_path / "job")
    assert str(tmp_path / "job" / "partial") in (caught.value.hint or "")


def test_a_malformed_table_is_named(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    path.write_text("camera,frame,time\ntorso,first,0\n", encoding="utf-8")
    with pytest.raises(JobError, match="cannot be read"):
        read_frame_table(path)
    path = tmp_path / "joints.csv"
    for text in ("", "time,joint\n0,Hips\n"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(JobError, match="cannot be read"):
            read_joint_table(path)


def test_times_of_the_day_keep_their_nanoseconds(tmp_path: Path) -> None:
    """A float64 of a Unix time has a resolution of 0.2 µs."""
    _, result = exported(tmp_path)
    table = result.folder / "frames.csv"
    head, first, *_ = table.read_text(encoding="utf-8").splitlines()
    cells = first.split(",")
    cells[2] = "1764460800.123456789"
    table.write_text(f"{head}\n{','.join(cells)}\n", encoding="utf-8")
    assert result.frames()["torso"].times_ns.tolist() == [1764460800123456789]


def test_the_package_offers_the_names_of_the_api() -> None:
    assert sorted(bodycap_batch.__all__) == sorted(api.__all__)
    assert all(getattr(bodycap_batch, name) is not None for name in bodycap_batch.__all__)
    assert bodycap_batch.BodyMotion is BodyMotion
    with pytest.raises(AttributeError, match="no attribute 'run'"):
        bodycap_batch.run  # noqa: B018


def test_the_reading_script_of_the_page_runs(tmp_path: Path) -> None:
    inputs = replace(inputs_of(tmp_path), out_dir=tmp_path / "out" / "my_walk")
    run(inputs)
    (script,) = [text for text in scripts() if 'Result("out/my_walk")' in text]
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env={"PYTHONPATH": str(PAGE.parents[2]), "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    for path in inputs.trajectories:
        lost = int((~path.localised).sum())
        assert lost
        assert f"{path.camera} world (60, 3) (60, 3, 3) {lost} frames lost" in done.stdout
    assert "motion.bvh" in done.stdout


def test_the_gate_script_is_short() -> None:
    (script,) = [text for text in scripts() if "sys.exit" in text]
    assert len([line for line in script.splitlines() if line]) == 10
