"""Tasks as JSON: the child reads back what the pipeline wrote, and the key holds contents, not paths."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import pytest

from bodycap_batch.config.limits import Limits
from bodycap_batch.config.models import Job
from bodycap_batch.config.options import (
    ExportOptions,
    KeyframeOptions,
    MapOptions,
    MergeOptions,
    RegistrationOptions,
    TelemetryOptions,
)
from bodycap_batch.pipeline.inputs import capture_ref
from bodycap_batch.pipeline.task_keys import artefact_key, make_task
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.tasks.check import CheckTask
from bodycap_batch.tasks.clocks import ClocksTask
from bodycap_batch.tasks.export import ExportTask
from bodycap_batch.tasks.fill import FillTask
from bodycap_batch.tasks.further import FurtherMapsTask, FurtherPosesTask
from bodycap_batch.tasks.inertial import InertialTask
from bodycap_batch.tasks.inputs import ArtefactRef, BodyInput, FileRef, MountInput, StatedClock
from bodycap_batch.tasks.keyframes import KeyframesTask
from bodycap_batch.tasks.links import LinksTask
from bodycap_batch.tasks.mapping import ExtendTask, MapTask, RefineTask
from bodycap_batch.tasks.merge import BoardFootage, MergeTask
from bodycap_batch.tasks.places import PlacesTask
from bodycap_batch.tasks.preview import PreviewTask
from bodycap_batch.tasks.recover import RecoverTask
from bodycap_batch.tasks.registration import RegistrationTask
from bodycap_batch.tasks.report import ReportTask
from bodycap_batch.tasks.rotations import RotationsTask
from bodycap_batch.tasks.sound import SoundTask
from bodycap_batch.tasks.stages import STAGES
from bodycap_batch.tasks.synth import SynthTask
from bodycap_batch.tasks.typed_json import from_json, key_inputs, key_options, to_json
from bodycap_batch.tasks.undistort import UndistortTask


def tasks(folder: Path) -> dict[str, Any]:
    """One task of every stage, all of whose paths lie in a folder."""
    cameras = [{"name": name, "video": [str(folder / f"{name}.mp4")]} for name in ("torso", "head")]
    job = Job.model_validate({"capture": {"cameras": cameras}, "height_m": 1.75, "name": "walk"})
    capture = capture_ref(job.capture, {"torso": "d1", "head": "d2"})
    stored = {name: ArtefactRef(path=folder / name, digest=f"of {name}") for name in ("torso", "head")}
    scene_map = ArtefactRef(path=folder / "map", digest="of the map")
    mount = MountInput(
        camera="torso",
        role="Spine1",
        place="torso",
        joint_from_cam=(
            (1.0, 0.0, 0.0, 0.1),
            (0.0, 1.0, 0.0, 0.0),
            (0.0, 0.0, 1.0, 0.0),
            (0.0, 0.0, 0.0, 1.0),
        ),
        sigma_deg=2.5,
        sigma_m=None,
    )
    body = BodyInput(
        skeleton=None,
        skeleton_file=FileRef(path=folder / "rig.bvh", digest="of the rig"),
        skeleton_map={"Bip01": "Hips"},
        tpose_frame=3,
        height_m=1.75,
        activity="walk",
        mounts=(mount,),
    )
    clocks = {"torso": StatedClock(offset_s=0.1, drift_ppm=None, role="Spine1")}
    together = {"capture": capture, "keyframes": stored, "map": scene_map, "registrations": stored}
    return {
        "synth": SynthTask(
            options=SynthOptions(motion=folder / "walk.bvh"),
            motion=FileRef(path=folder / "walk.bvh", digest="of the motion"),
            motion_name="walk.bvh",
        ),
        "check": CheckTask(
            job=job,
            cameras=capture.digests,
            clocks=clocks,
            body=body,
            formats=("bvh",),
            names="hik",
            limits=Limits(),
        ),
        "keyframes": KeyframesTask(options=KeyframeOptions(window=3), capture=capture),
        "map": MapTask(
            options=MapOptions(init_frames=("torso:1", "head:2")),
            capture=capture,
            keyframes=stored,
        ),
        "extend": ExtendTask(
            options=MapOptions(), capture=capture, keyframes=stored, map=scene_map, extra={"torso": (3, 7)}
        ),
        "refine": RefineTask(options=MapOptions(), capture=capture, map=scene_map, registrations=stored),
        "registration": RegistrationTask(
            options=RegistrationOptions(rounds=2),
            capture=capture,
            keyframes=stored,
            map=scene_map,
            previous=stored["torso"],
        ),
        "recover": RecoverTask(**together, options=RegistrationOptions(rounds=2), cameras=("torso", "head")),
        "inertial": InertialTask(
            options=TelemetryOptions(gravity=False),
            cameras=("torso", "head"),
            capture=capture,
            registrations=stored,
            samples={"torso": FileRef(path=folder / "torso.imu.csv", digest="of the samples")},
            stabilised=True,
        ),
        "further_maps": FurtherMapsTask(**together, options=MapOptions()),
        "further_poses": FurtherPosesTask(
            options=RegistrationOptions(rounds=2),
            capture=capture,
            keyframes=stored,
            map=scene_map,
            registration=scene_map,
        ),
        "links": LinksTask(keyframes=scene_map, map=scene_map, registration=scene_map),
        "rotations": RotationsTask(capture=capture, keyframes=stored, map=scene_map, registration=scene_map),
        "sound": SoundTask(
            capture=capture,
        ),
        "clocks": ClocksTask(
            capture=capture,
            stated=clocks,
            common="auto",
            rig="free",
            sound=scene_map,
            map=scene_map,
            registrations=stored,
            reach=(("head", "torso", 0.1, 0.9),),
        ),
        "places": PlacesTask(stated={"a": "torso"}, clocks={"": scene_map}, registrations=stored),
        "merge": MergeTask(
            options=MergeOptions(known_distance=("torso:1", "head:2", 1.5)),
            map=scene_map,
            registrations=stored,
            clocks=scene_map,
            body=body,
            footage=BoardFootage(capture=capture, keyframes=stored),
        ),
        "fill": FillTask(mode="rest", merge=scene_map),
        "export": ExportTask(
            options=ExportOptions(formats=("bvh", "ply")),
            take="walk",
            capture=capture,
            map=scene_map,
            registrations=stored,
            clocks=scene_map,
            keyframes=stored,
            links=stored,
            merge=None,
            failure="too few frames",
            freed={"torso": 0.6},
            segments=(("torso", "head"),),
        ),
        "report": ReportTask(
            **together,
            name="walk",
            failure={"stage": "merge", "line": 3},
            max_gap_s=0.5,
            clocks=None,
            merge=None,
            export=scene_map,
            body=body,
            places_from_motion={"gopro1": "torso"},
        ),
        "undistort": UndistortTask(camera="torso", capture=capture, map=scene_map, export=stored["torso"]),
        "preview": PreviewTask(**together, clocks=scene_map, merge=scene_map, failure=None),
    }


every_stage = pytest.mark.parametrize("name", sorted(STAGES))


@every_stage
def test_a_child_reads_back_the_task_that_was_written(tmp_path: Path, name: str) -> None:
    task = tasks(tmp_path)[name]
    written = json.loads(json.dumps(to_json(task)))
    assert from_json(STAGES[name].task, written) == task


@every_stage
def test_a_key_depends_on_contents_and_not_on_paths(tmp_path: Path, name: str) -> None:
    here, there = (artefact_key(tasks(tmp_path / place)[name]) for place in ("a", "b"))
    assert here == there
    assert str(tmp_path) not in json.dumps(here.document())


@every_stage
def test_a_key_names_every_field_that_is_not_left_out(tmp_path: Path, name: str) -> None:
    task = tasks(tmp_path)[name]
    named = {*key_inputs(task), *({"options"} if key_options(task) else ())}
    assert named == {field.name for field in fields(task)} - {"job"}


def test_another_digest_gives_another_key(tmp_path: Path) -> None:
    task = tasks(tmp_path)["map"]
    other = replace(
        task, keyframes={**task.keyframes, "head": ArtefactRef(path=tmp_path / "head", digest="x")}
    )
    assert artefact_key(task).name != artefact_key(other).name


@pytest.mark.parametrize(("name", "omitted"), [("registration", "rounds"), ("export", "preview")])
def test_options_without_influence_are_not_part_of_a_key(tmp_path: Path, name: str, omitted: str) -> None:
    task = tasks(tmp_path)[name]
    assert omitted in to_json(task)["options"]
    assert omitted not in key_options(task)


def test_the_store_finds_the_artefacts_that_a_task_reads(tmp_path: Path) -> None:
    from bodycap_batch.store.artefacts import Store

    store = Store(tmp_path)
    task = make_task(tasks(tmp_path / "artefacts" / "any")["recover"])
    found = {path.name for path in store.artefacts_in(task.arguments)}
    assert {"torso", "head", "map"} <= found
