"""Take, exact rate, timecode, validity and sigma in the files of the motion: each format that has a place."""

from __future__ import annotations

import json
from dataclasses import replace

import ezc3d
import numpy as np
import pygltflib
import pytest
from pxr import Usd, UsdGeom, UsdSkel

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.export.export_inputs import VideoFacts
from bodycap_batch.model.take import Timecode, exact_rate
from tests.bodies import merged, reaching

FPS = 30000 / 1001
UNSEEN = slice(10, 15)
SIGMA_M = 0.0042
RATE, START = "30000/1001", "10:00:00;12"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> ExportInputs:
    """The torso's file starts at 10:00:00;05, 7 frames before the motion. The chest is unseen for 5 ticks."""
    motion = reaching(40, fps=FPS)
    result, clocks = merged(motion, projected=False)
    chest = motion.skeleton.roles.index("Spine1")
    seen = result.observed.copy()
    seen[UNSEEN, chest] = False
    covariance = np.full((*seen.shape, 3, 3), np.nan)
    covariance[:, result.solved] = SIGMA_M**2 * np.eye(3)
    folder = tmp_path_factory.mktemp("results")
    inputs = ExportInputs(
        out_dir=folder,
        maps=(),
        trajectories=result.trajectories,
        clocks=clocks,
        reference_camera="torso",
        merge=replace(
            result,
            observed=seen,
            motion=replace(result.motion, observed=seen),
            joint_covariance_m2=covariance,
        ),
        take="walk 3",
        videos={
            "torso": VideoFacts(
                width_px=640,
                height_px=480,
                timecode=Timecode.parse("10:00:00;05", exact_rate(FPS)),
                first_frame_ns=motion.start_ns - round(7e9 / FPS),
            )
        },
    )
    options = ExportOptions(formats=("glb", "usd", "c3d", "trc", "npz", "blender"), tpose=True)
    export_results(inputs, options, StageContext(work_dir=folder))
    return inputs


def test_glb(inputs: ExportInputs) -> None:
    document = pygltflib.GLTF2.load_binary(str(inputs.out_dir / "motion.glb"))
    assert document is not None
    # The T-pose is a frame before the motion.
    assert document.extras["start_timecode"] == "10:00:00;11"
    assert (document.extras["rate"], document.extras["take"]) == (RATE, "walk 3")
    assert document.animations[0].name == "walk 3"
    extras = {node.name: node.extras for node in document.nodes}
    assert extras["Spine1"]["measured_frames"] == [[1, 10], [16, 40]]
    assert extras["Spine1"]["sigma_m"][:2] == [None, pytest.approx(SIGMA_M)]
    expected = {"role": "LeftUpLeg", "motion_source": "filled", "observed": False}
    assert extras["LeftUpLeg"] == expected


def test_usd(inputs: ExportInputs) -> None:
    stage = Usd.Stage.Open(str(inputs.out_dir / "motion.usd"))
    facts = stage.GetRootLayer().customLayerData
    assert (facts["rate"], facts["take"], facts["start_timecode"]) == (RATE, "walk 3", "10:00:00;11")
    assert stage.GetTimeCodesPerSecond() == FPS
    skeleton = UsdSkel.Skeleton.Get(stage, "/Body/Skeleton")
    chest = list(skeleton.GetJointNamesAttr().Get()).index("Spine1")
    variables = UsdGeom.PrimvarsAPI(skeleton)
    measured = [variables.GetPrimvar("measured").Get(float(frame))[chest] for frame in (0, 1, 10, 11, 15, 16)]
    assert measured == [False, True, True, False, False, True]
    assert variables.GetPrimvar("sigmaMetres").Get(3.0)[chest] == pytest.approx(SIGMA_M)
    assert np.isnan(variables.GetPrimvar("sigmaMetres").Get(0.0)[chest])


def test_c3d(inputs: ExportInputs) -> None:
    content = ezc3d.c3d(str(inputs.out_dir / "joints.c3d"))
    group = content["parameters"]["BODYCAP"]
    values = [group[name]["value"][0] for name in ("TAKE", "RATE", "START_TIMECODE")]
    assert values == ["walk 3", RATE, START]
    labels = content["parameters"]["POINT"]["LABELS"]["value"]
    residuals = content["data"]["meta_points"]["residuals"][0]
    chest = residuals[labels.index("Spine1")]
    assert chest[:10].tolist() == [4.0] * 10  # 4.2 mm, in whole millimetres
    assert chest[UNSEEN].tolist() == [0.0] * 5
    assert (residuals[labels.index("LeftUpLeg")] == -1.0).all()


def test_trc_npz_and_blender(inputs: ExportInputs) -> None:
    text = (inputs.out_dir / "joints.trc").read_text().splitlines()[2]
    assert float(text.split("\t")[0]) == pytest.approx(FPS, rel=1e-9)
    with np.load(inputs.out_dir / "joints.npz") as content:
        assert content["rate"].tolist() == [30000, 1001]
        assert (content["take"].item(), content["start_timecode"].item()) == ("walk 3", START)
    scene = json.loads((inputs.out_dir / "blender_scene.json").read_text())
    assert (scene["rate"], scene["start_timecode"], scene["take"]) == (RATE, "10:00:00;11", "walk 3")
