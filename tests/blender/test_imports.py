"""The files in the real client: Blender's own importers, defaults only, in a process of their own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tomllib
import zipfile
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodycap_batch.config.options import ExportOptions
from bodycap_batch.core.context import StageContext
from bodycap_batch.core.errors import JobError
from bodycap_batch.export import ExportInputs, export_results
from bodycap_batch.export.layout import apply_layout
from bodycap_batch.formats.fbx import find_blender, write_fbx
from bodycap_batch.formats.palette import CAMERA_COLOURS
from bodycap_batch.model.bone_axes import align_axes_with_bones, main_children
from bodycap_batch.model.geometry import Similarity, invert, rotation_angle_rad
from bodycap_batch.model.measured_parts import JointSource, filled_branches, joint_sources
from bodycap_batch.model.skeleton import Motion, rest_pose
from tests.bodies import merged, reaching
from tests.figures import skinned
from tests.scenes import small_map

pytestmark = pytest.mark.blender
REPOSITORY = Path(__file__).resolve().parents[2]
LOOK = Path(__file__).with_name("look.py")
SCENE = Path(__file__).with_name("look_at_scene.py")
PICTURES = REPOSITORY / "build" / "blender"
FORMATS = ("bvh", "glb", "fbx", "usd")
WORLD_FRAMES = 20


@pytest.fixture(scope="session")
def blender() -> Path:
    try:
        return find_blender()
    except JobError as error:
        pytest.skip(f"{error.message}; {error.hint}")


@dataclass(frozen=True)
class Seen:
    """What Blender says is in the scene."""

    report: dict[str, Any]

    @cached_property
    def world(self) -> np.ndarray:
        """(T,J,4,4) bone poses, in the order of `joints`."""
        return np.array([self.report["world"][name] for name in self.report["joints"]]).swapaxes(0, 1)

    @cached_property
    def rest(self) -> np.ndarray:
        """(J,4,4) bone poses at rest."""
        return np.array([self.report["rest"][name] for name in self.report["joints"]])

    def order(self, motion: Motion) -> list[int]:
        # Blender names bones by USD's tokens, which allow no colon.
        known = [name.replace(":", "_") for name in self.report["joints"]]
        return [known.index(name.replace(":", "_")) for name in motion.skeleton.joints]

    def joint_poses(self, motion: Motion) -> np.ndarray:
        """(T,J,4,4) world_from_joint in our convention: unturned at rest, without the file's scale."""
        order = self.order(motion)
        out = self.world[:, order]
        turn = out[..., :3, :3] @ np.linalg.inv(self.rest[order][:, :3, :3])
        return np.concatenate(
            [
                np.concatenate([turn, out[..., :3, 3:]], axis=-1),
                np.broadcast_to([[0, 0, 0, 1]], (*out.shape[:2], 1, 4)),
            ],
            axis=-2,
        )


def look(blender: Path, folder: Path, fps: float, *files: Path, picture: Path | None = None) -> Seen:
    target = folder / "report.json"
    more = [] if picture is None else ["--picture", str(picture)]
    command = [str(blender), str(LOOK), str(target), str(fps), *map(str, files), *more]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300, env=clean())
    assert done.returncode == 0, done.stderr[-2000:]
    return Seen(json.loads(target.read_text()))


def clean() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


@dataclass(frozen=True)
class Case:
    """Results of an export, the motion they hold, and what Blender made of each format."""

    folder: Path
    inputs: ExportInputs
    motion: Motion
    seen: dict[str, Seen]


@pytest.fixture(scope="session")
def case(blender: Path, tmp_path_factory: pytest.TempPathFactory) -> Case:
    folder = tmp_path_factory.mktemp("results")
    result, clocks = merged(reaching(60), world_from_map={"map-0": Similarity(1.0, np.eye(3), np.zeros(3))})
    inputs = ExportInputs(
        out_dir=folder, maps=(small_map(),), trajectories=result.trajectories, clocks=clocks, merge=result
    )
    options = ExportOptions(formats=(*FORMATS, "ply", "tum", "blender"))
    export_results(inputs, options, StageContext(work_dir=folder))
    PICTURES.mkdir(parents=True, exist_ok=True)
    seen = {
        name: look(blender, folder, 30.0, folder / f"motion.{name}", picture=PICTURES / f"{name}.png")
        for name in FORMATS
    }
    return Case(folder, inputs, result.motion, seen)


@pytest.fixture(params=FORMATS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


def test_all_joints_and_no_other_bones(case: Case, name: str) -> None:
    report = case.seen[name].report
    assert sorted(report["joints"]) == sorted(case.motion.skeleton.joints)
    body = case.motion.skeleton
    parents = {
        joint: body.joints[parent] if parent >= 0 else None
        for joint, parent in zip(body.joints, body.parents, strict=True)
    }
    assert report["parents"] == parents


def test_each_bone_has_the_source_of_its_motion_as_a_property(case: Case, name: str) -> None:
    if name not in ("glb", "fbx"):
        pytest.skip("BVH has no place for it, and Blender does not import the primvars of a USD skeleton")
    sources = (source.value for source in joint_sources(case.motion))
    assert case.seen[name].report["sources"] == dict(zip(case.motion.skeleton.joints, sources, strict=True))


def test_it_stands_upright_faces_minus_y_and_has_its_size(case: Case, name: str) -> None:
    seen, body = case.seen[name], case.motion.skeleton
    rest = dict(zip(seen.report["joints"], seen.rest[:, :3, 3], strict=True))
    # T-pose: head above hips, hands out to ±X at shoulder height, toes before the ankles (−Y)
    assert rest["Head"][2] - rest["Hips"][2] > 0.5
    assert rest["LeftHand"][0] > 0.7 > -0.7 > rest["RightHand"][0]
    assert abs(rest["LeftHand"][2] - rest["LeftArm"][2]) < 1e-3
    assert rest["LeftToeBase"][1] < rest["LeftFoot"][1] - 0.05
    for joint in range(1, len(body.joints)):
        bone = rest[body.joints[joint]] - rest[body.joints[body.parents[joint]]]
        np.testing.assert_allclose(bone, body.offsets_m[joint], atol=1e-4)


def test_joints_are_where_ours_are(case: Case, name: str) -> None:
    """Within 1 mm at 20 frames."""
    seen = case.seen[name]
    first, last = seen.report["frames"]
    assert last - first + 1 == len(case.motion.root_in_world_m)
    ticks = np.linspace(0, last - first, WORLD_FRAMES).round().astype(int)
    found = seen.world[:, seen.order(case.motion)][ticks]
    expected = case.motion.world_from_joint()[ticks]
    assert np.linalg.norm(found[..., :3, 3] - expected[..., :3, 3], axis=-1).max() < 1e-3
    turned = np.swapaxes(seen.joint_poses(case.motion)[ticks][..., :3, :3], -1, -2) @ expected[..., :3, :3]
    # single precision in Blender, and its bones' own axes in between
    assert np.degrees(rotation_angle_rad(turned)).max() < 0.05


def test_rate_and_steps(case: Case, name: str) -> None:
    """No local rotation jumps: at most 60° in 1/30 s, on matrices."""
    seen = case.seen[name]
    assert seen.report["fps"] == pytest.approx(30.0)
    poses = seen.joint_poses(case.motion)
    parents = case.motion.skeleton.parents
    local = np.concatenate([poses[:, :1], invert(poses[:, parents[1:]]) @ poses[:, 1:]], axis=1)[..., :3, :3]
    step = np.swapaxes(local[:-1], -1, -2) @ local[1:]
    assert np.degrees(rotation_angle_rad(step)).max() < 60.0


def test_the_mannequin_moves_with_its_bones(case: Case, name: str) -> None:
    if name == "bvh":
        pytest.skip("a BVH has no mesh")
    ((figure, vertices),) = case.seen[name].report["figure"].items()
    assert figure == "Mannequin"
    found, expected = np.array(vertices), skinned(case.motion, -1)
    # Blender merges vertices of one place and orders them anew.
    assert len(found) == pytest.approx(len(expected), rel=0.02)
    for some, others in ((found, expected), (expected, found)):
        off = [np.linalg.norm(others - each, axis=1).min() for each in some[::7]]
        assert max(off) < 1e-3


def test_nothing_else_is_in_the_scene(case: Case, name: str) -> None:
    expected = {
        "bvh": ["ARMATURE motion"],
        "glb": ["ARMATURE Armature", "MESH Mannequin"],
        "fbx": ["ARMATURE Armature", "MESH Mannequin"],
        "usd": ["ARMATURE Skeleton", "EMPTY Body", "MESH Mannequin"],
    }
    assert case.seen[name].report["objects"] == expected[name]


def test_keys_stand_on_whole_frames(case: Case, name: str) -> None:
    keys = np.array(case.seen[name].report["keys"])
    np.testing.assert_allclose(keys, np.round(keys), atol=1e-3)
    np.testing.assert_allclose(np.diff(keys), 1.0, atol=1e-3)


@pytest.mark.parametrize("name", ["bvh", "glb", "fbx"])
def test_bones_point_along_themselves(case: Case, name: str) -> None:
    """Each bone ends on the line to its child; the chains of the limbs are connected."""
    seen, body = case.seen[name], case.motion.skeleton
    heads = dict(zip(seen.report["joints"], seen.rest[:, :3, 3], strict=True))
    if name == "bvh":
        pytest.skip("Blender makes the bones of a BVH itself, from the joints")
    for joint, child in enumerate(main_children(body)):
        if child is None:
            continue
        head, tail = heads[body.joints[joint]], np.array(seen.report["tails"][body.joints[joint]])
        bone = heads[body.joints[child]] - head
        along = (tail - head) / np.linalg.norm(tail - head)
        assert along @ bone / np.linalg.norm(bone) > 1.0 - 1e-6
        if body.parents.tolist().count(joint) == 1:
            np.testing.assert_allclose(tail, heads[body.joints[child]], atol=1e-3)


def test_a_picture_shows_a_body(case: Case, name: str) -> None:
    picture = cv2.imread(str(PICTURES / f"{name}.png"))
    assert picture is not None
    assert picture.std() > 5.0


@pytest.mark.parametrize("units", ["cm", "m"])
def test_room_and_body_share_one_scene(case: Case, blender: Path, tmp_path: Path, units: str) -> None:
    """Each camera's path in the PLY and its mount on the armature agree within 2 cm (95 % of the frames)."""
    bvh = case.folder / "motion.bvh"
    if units == "m":
        inputs = replace(case.inputs, out_dir=tmp_path / "metres")
        export_results(inputs, ExportOptions(formats=("bvh",), units="m"), StageContext(work_dir=tmp_path))
        bvh = (tmp_path / "metres" / "motion.bvh").rename(tmp_path / "motion_m.bvh")
    seen = look(blender, tmp_path, 30.0, case.folder / "map.ply", bvh)
    (points,), (colors,) = seen.report["clouds"].values(), seen.report["colors"].values()
    cloud, shade = np.array(points), np.round(np.array(colors)[:, :3] * 255)
    poses = seen.joint_poses(case.motion)
    assert case.inputs.merge is not None
    for number, mount in enumerate(sorted(case.inputs.merge.mounts, key=lambda each: each.camera)):
        path = cloud[(np.abs(shade - CAMERA_COLOURS[number]) <= 1).all(axis=1)]
        assert len(path) > 100
        joint = case.motion.skeleton.roles.index(mount.role)
        trajectory = next(t for t in case.inputs.merge.trajectories if t.camera == mount.camera)
        riding = (poses[:, joint] @ mount.joint_from_cam)[trajectory.localised, :3, 3]
        off = np.linalg.norm(riding[:, None] - path[None], axis=-1).min(axis=1)
        assert np.percentile(off, 95) < 0.02


@pytest.mark.parametrize("names", ["mixamo", "unreal"])
@pytest.mark.parametrize("root", ["ground", "in_place"])
def test_other_layouts_arrive(case: Case, blender: Path, tmp_path: Path, names: str, root: str) -> None:
    options = ExportOptions.model_validate(
        {"names": names, "root": root, "fps": 60, "tpose": True, "formats": FORMATS}
    )
    export_results(replace(case.inputs, out_dir=tmp_path), options, StageContext(work_dir=tmp_path))
    motion = apply_layout(case.motion, options)
    for name in FORMATS:
        seen = look(blender, tmp_path, 60.0, tmp_path / f"motion.{name}")
        found = seen.world[:, seen.order(motion)]
        assert len(found) == len(motion.root_in_world_m) == 120
        expected = motion.world_from_joint()
        assert np.linalg.norm(found[..., :3, 3] - expected[..., :3, 3], axis=-1).max() < 1e-3


@pytest.mark.parametrize("fps", [24000 / 1001, 29.97, 50.0])
def test_fbx_keeps_odd_rates(case: Case, blender: Path, tmp_path: Path, fps: float) -> None:
    """The writer reads the file back and compares all joints; the T-pose is the pose of the file's nodes."""
    aligned = align_axes_with_bones(replace(case.motion, fps=fps))
    write_fbx(tmp_path / "a.fbx", aligned)
    code = (
        "import importlib, json, sys\n"
        "import bpy\n"
        "root, _ = importlib.import_module('io_scene_fbx.parse_fbx').parse(sys.argv[-1])\n"
        "objects = next(e for e in root.elems if e.id == b'Objects')\n"
        "facts = {}\n"
        "for model in (e for e in objects.elems if e.id == b'Model'):\n"
        "    values = next(e for e in model.elems if e.id == b'Properties70').elems\n"
        "    name = model.props[1].split(b'\\0')[0].decode()\n"
        "    local = [v.props for v in values if v.props[0][:3] == b'Lcl']\n"
        "    facts[name] = {props[0].decode(): list(props[4:]) for props in local}\n"
        "settings = next(e for e in root.elems if e.id == b'GlobalSettings').elems\n"
        "rows = next(e for e in settings if e.id == b'Properties70').elems\n"
        "facts['rate'] = next(v.props[4] for v in rows if v.props[0] == b'CustomFrameRate')\n"
        "print('facts', json.dumps(facts))\n"
    )
    done = subprocess.run(
        [str(blender), "-c", code, str(tmp_path / "a.fbx")],
        capture_output=True, text=True, check=False, timeout=300, env=clean(),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    (line,) = [row for row in done.stdout.splitlines() if row.startswith("facts")]
    facts = json.loads(line[6:])
    assert facts["rate"] == pytest.approx(fps, rel=1e-5)
    skeleton = aligned.skeleton
    placed: list[np.ndarray] = []
    for name, parent in zip(skeleton.joints, skeleton.parents.tolist(), strict=True):
        turn = Rotation.from_euler("xyz", facts[name]["Lcl Rotation"], degrees=True).as_matrix()
        local = np.eye(4)
        local[:3, :3], local[:3, 3] = turn, facts[name]["Lcl Translation"]
        placed.append(local if parent < 0 else placed[parent] @ local)
    found = np.array(placed)[:, :3, 3] / 100.0 @ [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    np.testing.assert_allclose(found, rest_pose(skeleton)[:, :3, 3], atol=1e-4)


def test_the_script_builds_the_scene(case: Case, blender: Path, tmp_path: Path) -> None:
    """Body, room, cameras with videos, rate, range and markers; the joints where the BVH has them."""
    folder = tmp_path / "results"
    shutil.copytree(case.folder, folder)
    merge = case.inputs.merge
    assert merge is not None
    video = tmp_path / "torso.mp4"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"mp4v"), 30.0, (64, 48))
    for _ in range(70):
        writer.write(np.zeros((48, 64, 3), dtype=np.uint8))
    writer.release()
    (folder / "run.json").write_text(json.dumps({"videos": {"torso": [str(video)]}}))
    blend, facts = tmp_path / "scene.blend", tmp_path / "facts.json"
    script = str(folder / "blender_scene.py")
    for command in ([script, "--", "--save", str(blend)], [str(SCENE), str(blend), str(facts)]):
        done = subprocess.run(
            [str(blender), *command], capture_output=True, text=True, check=False, timeout=300, env=clean()
        )
        assert done.returncode == 0, done.stderr[-2000:]
    seen = json.loads(facts.read_text())
    assert seen["fps"] == pytest.approx(30.0)
    assert seen["range"] == [1, 60]
    # The small map has no lens for the camera of the right palm.
    lenses = case.inputs.maps[0].cameras
    expected_objects = {"Body": "ARMATURE", "Mannequin": "MESH", "Room": "MESH"}
    assert seen["objects"] == {**expected_objects, **dict.fromkeys(lenses, "CAMERA")}
    assert seen["keys"] == list(range(1, 61))
    motion = case.motion
    expected = motion.world_from_joint()
    for joint, name in enumerate(motion.skeleton.joints):
        np.testing.assert_allclose(seen["joints"][name], expected[[0, 30, 59], joint, :3, 3], atol=1e-3)
    for path in (each for each in merge.trajectories if each.camera in lenses):
        pose = np.array(seen["cameras"][path.camera])
        turned = path.gauge_from_cam[[0, 30, 59]] @ np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(pose[:, :3, 3], turned[:, :3, 3], atol=1e-3)
        np.testing.assert_allclose(pose[:, :3, :3], turned[:, :3, :3], atol=2e-3)
    assert seen["videos"] == {"torso": "torso.mp4"}
    assert seen["connected"] > 10
    sources = dict(zip(motion.skeleton.joints, joint_sources(motion), strict=True))
    for source in JointSource:
        names = sorted(name for name, each in sources.items() if each == source)
        assert seen["collections"][source]["bones"] == names
        assert len(seen["collections"][source]["colours"]) == 1
    assert seen["collections"]["measured"]["colours"] != seen["collections"]["filled"]["colours"]
    assert seen["properties"] == {name: source.value for name, source in sources.items()}
    # The filled limbs can be muted: nothing that carries a measured joint is among them.
    assert seen["tracks"] == ["filled"]
    limbs = {name for name, each in zip(motion.skeleton.joints, filled_branches(motion), strict=True) if each}
    assert set(seen["filled_actions"]) == limbs
    assert any("Leg" in name for name in limbs)
    before, muted = ({n: np.array(p) for n, p in seen[key].items()} for key in ("poses", "muted"))
    for name in motion.skeleton.joints:
        off = np.linalg.norm(muted[name][:, :3, 3] - before[name][:, :3, 3], axis=1).max()
        assert off < 1e-3 or name in limbs, f"{name} moves by {off} m"
    assert max(np.ptp(muted[name][:, :3, :3], axis=0).max() for name in limbs) > 0.0, (
        "they follow their parent"
    )
    (frame, text), *_ = seen["markers"]
    assert frame == 1
    assert text.startswith("not measured: ")
    # The view through a body camera is that of its lens: a point on its axis is in the middle of the picture.
    for name, (x, y) in seen["axis_in_view"].items():
        lens = lenses[name]
        centre = np.array(lens.principal_point_px) / [lens.width_px, lens.height_px]
        np.testing.assert_allclose([x, 1.0 - y], centre, atol=2e-3)


def test_fbx_is_the_same_twice(case: Case, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_fbx(tmp_path / f"{name}.fbx", case.motion)
    assert (tmp_path / "a.fbx").read_bytes() == (tmp_path / "b.fbx").read_bytes()


def test_the_extension_imports_a_results_folder(case: Case, blender: Path, tmp_path: Path) -> None:
    """The ZIP file holds a manifest and the same code as the script; its operator builds the scene."""
    with zipfile.ZipFile(case.folder / "bodycap_blender.zip") as archive:
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        code = archive.read("__init__.py")
    assert code == (case.folder / "blender_scene.py").read_bytes()
    needed = {"schema_version", "id", "version", "name", "tagline", "maintainer", "type", "license"}
    assert needed | {"blender_version_min"} <= set(manifest)
    assert manifest["blender_version_min"] == "4.2.0"
    (tmp_path / "bodycap_results").mkdir()
    (tmp_path / "bodycap_results" / "__init__.py").write_bytes(code)
    used = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "import bpy, bodycap_results\n"
        "bpy.ops.wm.read_factory_settings(use_empty=True)\n"
        "bodycap_results.register()\n"
        f"bpy.ops.import_scene.bodycap(filepath={str(case.folder / 'blender_scene.json')!r})\n"
        "print('found', *sorted(item.type for item in bpy.data.objects))\n"
        "bodycap_results.unregister()\n"
        "print('left', hasattr(bpy.types, 'IMPORT_SCENE_OT_bodycap'))\n"
    )
    done = subprocess.run(
        [str(blender), "-c", used], capture_output=True, text=True, check=False, timeout=300, env=clean()
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "found ARMATURE CAMERA CAMERA MESH MESH" in done.stdout
    assert "left False" in done.stdout
