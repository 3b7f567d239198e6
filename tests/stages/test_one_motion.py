"""Page, video and files show one motion: joint centres are read from every output and compared.

The joints of the graph's solution differ from the rigid motion by millimetres in these inputs, so an output
that shows the graph fails.
"""

from __future__ import annotations

import base64
import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trc import TRCData

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.formats.bvh import read_bvh
from bodycap_batch.formats.c3d import read_c3d
from bodycap_batch.formats.gltf import read_glb
from bodycap_batch.formats.usd import read_usd
from bodycap_batch.model.skeleton import Motion
from bodycap_batch.overlay import bones_from_motion
from bodycap_batch.report.drawn_scene import make_drawn_scene
from bodycap_batch.report.packing import PageBudget
from bodycap_batch.report.viewer_data import make_viewer_data
from tests.bodies import ARMS
from tests.reports import report_inputs
from tests.stages.test_export import inputs_of, run

TOLERANCE_M = 1e-4
"""Files hold millimetres with three digits or more; the page quantises the walk of 2 m to 0.03 mm."""
FORMATS = ("bvh", "glb", "usd", "c3d", "trc", "csv", "npz")
MEASURING = {"c3d", "trc", "csv", "npz"}
"""Files for measuring hold the solved motion whatever the layout for animation is."""


def centres_of(motion: Motion | None) -> dict[str, FloatArray]:
    assert motion is not None
    poses = motion.world_from_joint()
    return {name: poses[:, joint, :3, 3] for joint, name in enumerate(motion.skeleton.joints)}


def read_csv(path: Path) -> dict[str, FloatArray]:
    rows: dict[str, list[list[float]]] = {}
    with path.open(newline="", encoding="utf-8") as stream:
        for row in csv.DictReader(line for line in stream if not line.startswith("#")):
            rows.setdefault(row["joint"], []).append([float(row[axis]) for axis in ("x_m", "y_m", "z_m")])
    return {name: np.array(values) for name, values in rows.items()}


def read_npz(path: Path) -> dict[str, FloatArray]:
    with np.load(path) as arrays:
        return {str(name): arrays["world"][:, joint] for joint, name in enumerate(arrays["names"])}


def read_trc(path: Path) -> dict[str, FloatArray]:
    data = TRCData()
    data.load(str(path))
    # The file's axes are x = −y, y = z, z = −x of the world, in millimetres.
    return {name: np.array(data[name])[:, [2, 0, 1]] * [-1e-3, -1e-3, 1e-3] for name in data["Markers"]}


def read_points(path: Path) -> dict[str, FloatArray]:
    points = read_c3d(path)
    return {name: points.x_in_world_m[:, joint] for joint, name in enumerate(points.names)}


READERS = {
    "bvh": ("motion.bvh", lambda path: centres_of(read_bvh(path)[1])),
    "glb": ("motion.glb", lambda path: centres_of(read_glb(path))),
    "usd": ("motion.usd", lambda path: centres_of(read_usd(path))),
    "c3d": ("joints.c3d", read_points),
    "trc": ("joints.trc", read_trc),
    "csv": ("joints.csv", read_csv),
    "npz": ("joints.npz", read_npz),
}


def difference_m(found: dict[str, FloatArray], motion: Motion) -> float:
    """Largest distance of a joint's centre in an output from the motion; all its joints must be there.

    C3D readers give no numbers for joints that no camera measured.
    """
    expected = centres_of(motion)
    assert set(found) == set(expected)
    given = [name for name in expected if np.isfinite(found[name]).all()]
    assert len(given) >= len(ARMS)
    return max(float(np.linalg.norm(found[name] - expected[name], axis=1).max()) for name in given)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("one_motion")


def test_the_graph_differs_from_the_motion(folder: Path) -> None:
    merge = inputs_of(folder).merge
    assert merge is not None
    off = merge.graph_world_from_joint[..., :3, 3] - merge.motion.world_from_joint()[..., :3, 3]
    assert np.linalg.norm(off, axis=-1).max() > 20 * TOLERANCE_M


@pytest.mark.parametrize("name", FORMATS)
def test_each_file_holds_the_motion(folder: Path, name: str) -> None:
    inputs = inputs_of(folder / name)
    run(inputs, formats=(name,), filled_markers=True)
    file, read = READERS[name]
    assert inputs.merge is not None
    assert difference_m(read(inputs.out_dir / file), inputs.merge.motion) < TOLERANCE_M


@pytest.mark.parametrize("option", [{"smoothing_hz": 4.0}, {"fps": 60.0}], ids=["smoothing", "rate"])
@pytest.mark.parametrize("name", FORMATS)
def test_only_files_for_animation_follow_the_layout(
    folder: Path, name: str, option: dict[str, float]
) -> None:
    inputs = inputs_of(folder / f"{name}_{next(iter(option))}")
    run(inputs, formats=(name,), filled_markers=True, **option)
    file, read = READERS[name]
    assert inputs.merge is not None
    found, motion = read(inputs.out_dir / file), inputs.merge.motion
    if name in MEASURING:
        assert difference_m(found, motion) < TOLERANCE_M
    elif "fps" in option:
        # Every second tick of twice the rate is one of the motion's.
        assert difference_m({joint: each[::2] for joint, each in found.items()}, motion) < TOLERANCE_M
    else:
        assert difference_m(found, motion) > 10 * TOLERANCE_M


def unpacked(packed: dict[str, Any]) -> FloatArray:
    """Numbers of the page, from 16 bits between each column's least and largest value."""
    codes = np.frombuffer(base64.b64decode(packed["u16"]), dtype="<u2").astype(float)
    values = codes.reshape(-1, len(packed["low"])) * packed["step"] + packed["low"]
    return np.asarray(values.reshape(packed["shape"]))


def test_the_page_shows_the_motion() -> None:
    inputs = report_inputs()
    merge = inputs.merge
    assert merge is not None
    body = make_viewer_data(inputs, make_drawn_scene(inputs), PageBudget())["body"]
    centres = unpacked(body["centres"])[:, : len(body["joints"])]
    shown = {name: centres[:, joint] for joint, name in enumerate(body["joints"])}
    assert difference_m(shown, merge.motion) < TOLERANCE_M


def test_pictures_and_video_show_the_motion() -> None:
    """The bones drawn over the page's pictures, and those of the video, begin at joints of the motion."""
    merge = report_inputs().merge
    assert merge is not None
    poses = merge.motion.world_from_joint()
    for body in (bones_from_motion(merge.motion, merge.solved), bones_from_motion(merge.motion)):
        off = body.ends_in_world[:, :, 0] - poses[..., :3, 3][:, body.joints]
        assert np.linalg.norm(off, axis=-1).max() < TOLERANCE_M
