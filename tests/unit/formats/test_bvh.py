"""BVH files: round trips, files of other programs, and errors that name the line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.core.errors import JobError, StoreError
from bodycap_batch.formats.bvh import read_bvh, write_bvh
from bodycap_batch.formats.bvh.euler import continuous_angles, rotation_from_angles
from bodycap_batch.model.geometry import rotation_angle_rad
from bodycap_batch.model.skeleton import Motion, SkeletonModel
from tests.bodies import BVH_PAIR

ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")

# Half a unit of the sixth decimal in each of three angles, in radians.
ANGLE_TOLERANCE_RAD = 3 * np.deg2rad(0.5e-6) + 2e-7
# Half a unit of the sixth decimal of a centimetre on each of three axes.
POSITION_TOLERANCE_M = 1e-8


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)


def write(folder: Path, text: str, name: str = "file.bvh") -> Path:
    path = folder / name
    path.write_bytes(text.encode("utf-8"))
    return path


def skeleton(parents: list[int], rng: np.random.Generator) -> SkeletonModel:
    count = len(parents)
    offsets = rng.normal(scale=0.3, size=(count, 3))
    offsets[rng.random(count) < 0.2] = 0.0
    leaf = ~np.isin(np.arange(count), parents)
    return SkeletonModel(
        name="random",
        joints=tuple(f"joint {i}" for i in range(count)),
        parents=np.array(parents),
        offsets_m=offsets,
        end_offsets_m=np.where(leaf[:, None], rng.normal(scale=0.1, size=(count, 3)), np.nan),
        roles=("",) * count,
        bvh_channels=((),) * count,
    )


def motion(model: SkeletonModel, local_rotation: FloatArray, rng: np.random.Generator) -> Motion:
    ticks = len(local_rotation)
    return Motion(
        skeleton=model,
        fps=30.0,
        start_ns=0,
        root_in_world_m=rng.normal(size=(ticks, 3)),
        local_rotation=local_rotation,
        observed=np.ones(local_rotation.shape[:2], dtype=bool),
    )


def reference_positions(path: Path) -> FloatArray:
    """Return joint centres (T,J,3) in file axes and units, read by an independent parser."""
    rows = path.read_text().splitlines()
    start = rows.index("MOTION")
    frames = [list(map(float, row.split())) for row in rows[start + 3 :]]
    out = []
    for frame in frames:
        numbers, stack, placed = iter(frame), [], []
        for row in rows[1:start]:
            words = row.split()
            if words[0] in ("ROOT", "JOINT", "End"):
                stack.append([np.eye(3), np.zeros(3), words[0] == "End"])
            elif words[0] == "OFFSET":
                upper = stack[-2] if len(stack) > 1 else (np.eye(3), np.zeros(3), False)
                stack[-1][1] = upper[1] + upper[0] @ np.array(words[1:], dtype=float)
                stack[-1][0] = upper[0]
            elif words[0] == "CHANNELS":
                for channel in words[2:]:
                    value = next(numbers)
                    if channel.endswith("rotation"):
                        turn = Rotation.from_euler(channel[0].lower(), value, degrees=True).as_matrix()
                        stack[-1][0] = stack[-1][0] @ turn
                    else:
                        stack[-1][1] = stack[-1][1].copy()
                        stack[-1][1]["XYZ".index(channel[0])] = value
                placed.append(stack[-1][1])
            elif words[0] == "}":
                stack.pop()
        out.append(placed)
    return np.array(out)


@st.composite
def motions(draw: st.DrawFn) -> Motion:
    count = draw(st.integers(1, 8))
    parents = [-1] + [draw(st.integers(0, i - 1)) for i in range(1, count)]
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    ticks = draw(st.integers(1, 6))
    kind = draw(st.sampled_from(["any", "quarter turns", "near the lock", "small"]))
    size = ticks * count
    if kind == "any":
        rotation = Rotation.random(size, random_state=rng).as_matrix()
    elif kind == "small":
        rotation = Rotation.from_rotvec(rng.normal(scale=1e-3, size=(size, 3))).as_matrix()
    else:
        angles = rng.integers(-4, 5, size=(size, 3)) * 90.0
        angles += rng.normal(size=(size, 3)) * (
            0.0 if kind == "quarter turns" else 10.0 ** rng.uniform(-9, -1)
        )
        rotation = Rotation.from_euler(draw(st.sampled_from(ORDERS)), angles, degrees=True).as_matrix()
    return motion(skeleton(parents, rng), rotation.reshape(ticks, count, 3, 3), rng)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(moving=motions(), order=st.sampled_from(ORDERS), units=st.sampled_from(["cm", "m"]))
def test_round_trip(tmp_path_factory: pytest.TempPathFactory, moving: Motion, order: str, units: str) -> None:
    path = tmp_path_factory.mktemp("bvh") / "random.bvh"
    write_bvh(path, moving, units=units, euler_order=order)
    model, back = read_bvh(path, units=units)
    assert back is not None
    assert sorted(model.joints) == sorted(moving.skeleton.joints)
    here = [model.joints.index(name) for name in moving.skeleton.joints]
    parent = {name: model.joints[model.parents[i]] for i, name in enumerate(model.joints) if i}
    for joint in range(1, len(here)):
        assert parent[moving.skeleton.joints[joint]] == moving.skeleton.joints[moving.skeleton.parents[joint]]
    turned = np.swapaxes(back.local_rotation[:, here], -1, -2) @ moving.local_rotation
    assert rotation_angle_rad(turned).max() < ANGLE_TOLERANCE_RAD
    assert np.abs(back.root_in_world_m - moving.root_in_world_m).max() < POSITION_TOLERANCE_M
    assert np.abs(model.offsets_m[here][1:] - moving.skeleton.offsets_m[1:]).max(initial=0.0) < 1e-12
    ends, expected = model.end_offsets_m[here], moving.skeleton.end_offsets_m
    np.testing.assert_allclose(ends, expected, atol=1e-12)
    assert back.fps == 30.0


@settings(max_examples=40, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), order=st.sampled_from(ORDERS))
def test_angles_are_continuous_through_the_lock_and_over_many_turns(seed: int, order: str) -> None:
    """The joint rotates by at most 0.1 rad per tick, and its middle angle passes ±90° many times."""
    rng = np.random.default_rng(seed)
    angles = np.cumsum(rng.uniform(-0.03, 0.07, size=(400, 3)), axis=0)
    rotation = rotation_from_angles(order, angles)
    out = continuous_angles((order,), rotation[:, None])[:, 0]
    # The angles may be the equivalent triple or differ by full turns; both change exactly as the truth does.
    np.testing.assert_allclose(np.abs(np.diff(out, axis=0)), np.abs(np.diff(angles, axis=0)), atol=1e-6)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("quarter", [-90.0, 90.0])
def test_exact_gimbal_lock_keeps_the_angles_close(order: str, quarter: float) -> None:
    first = np.deg2rad(np.linspace(0.0, 300.0, 61))
    angles = np.stack([first, np.full(61, np.deg2rad(quarter)), np.zeros(61)], axis=1)
    rotation = rotation_from_angles(order, angles)
    out = continuous_angles((order,), rotation[:, None])[:, 0]
    np.testing.assert_allclose(rotation_from_angles(order, out), rotation, atol=1e-9)
    # Each tick rotates by 5° about the two locked axes together, so neither may change by more than that.
    assert np.abs(np.diff(out, axis=0)).max() < np.deg2rad(5.001)


@pytest.mark.parametrize("order", ORDERS)
def test_rotation_order_agrees_with_scipy(order: str, rng: np.random.Generator) -> None:
    angles = rng.uniform(-np.pi, np.pi, size=(50, 3))
    expected = Rotation.from_euler(order, angles).as_matrix()
    np.testing.assert_allclose(rotation_from_angles(order, angles), expected, atol=1e-14)


def test_axes_and_units(tmp_path: Path) -> None:
    """File: Y up, faces +Z, left +X, cm. World: Z up, faces −Y, left +X, metres."""
    model, moving = read_bvh(write(tmp_path, BVH_PAIR))
    assert moving is not None
    np.testing.assert_allclose(moving.root_in_world_m[0], [0.01, -0.02, 1.0])
    np.testing.assert_allclose(model.offsets_m[1], [0.2, 0.0, 0.0])
    joints = moving.world_from_joint()
    tip = joints[0, 1, :3, :3] @ model.end_offsets_m[1] + joints[0, 1, :3, 3]
    # First frame: +90° about the file's Z (forward) lifts the left arm. Second frame: +90° about the file's
    # Y (up) rotates the left side to the back, which is +Y in the world.
    np.testing.assert_allclose(tip, [0.21, -0.02, 1.3], atol=1e-12)
    np.testing.assert_allclose(joints[1, 1, :3, 3], [0.01, 0.18, 1.0], atol=1e-12)


def test_positions_agree_with_an_independent_reader(tmp_path: Path, rng: np.random.Generator) -> None:
    model = skeleton([-1, 0, 1, 2, 0, 4, 0], rng)
    moving = motion(model, Rotation.random(7 * 5, random_state=rng).as_matrix().reshape(5, 7, 3, 3), rng)
    write_bvh(tmp_path / "a.bvh", moving)
    ours = moving.world_from_joint()[..., :3, 3]
    file_axes = np.stack([ours[..., 0], ours[..., 2], -ours[..., 1]], axis=-1) * 100.0
    # 3e-8 rad per joint on a chain of four bones of up to 1 m, in cm
    np.testing.assert_allclose(reference_positions(tmp_path / "a.bvh"), file_axes, atol=1e-4)


def test_a_files_hierarchy_offsets_and_channels_are_kept(tmp_path: Path) -> None:
    text = BVH_PAIR.replace("OFFSET 20 0 0", "OFFSET 20.123456789 -0.1 1e-3")
    text = text.replace("3 Zrotation Xrotation Yrotation", "3 Yrotation Xrotation Zrotation")
    _, moving = read_bvh(write(tmp_path, text))
    assert moving is not None
    write_bvh(tmp_path / "b.bvh", moving, euler_order="XYZ")
    written = (tmp_path / "b.bvh").read_text()
    assert "OFFSET 20.123456789 -0.100000 0.001000" in written
    assert "CHANNELS 3 Yrotation Xrotation Zrotation" in written
    assert "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation" in written


def test_default_layout(tmp_path: Path, rng: np.random.Generator) -> None:
    model = skeleton([-1, 0], rng)
    # some readers add the OFFSET of the root to its path, so it must be zero
    model = replace(model, offsets_m=np.array([[0.0, 0.0, 0.9], [0.1, 0.0, 0.2]]))
    moving = motion(model, np.broadcast_to(np.eye(3), (3, 2, 3, 3)), rng)
    write_bvh(tmp_path / "a.bvh", moving)
    rows = (tmp_path / "a.bvh").read_text().splitlines()
    assert rows[3:5] == [
        "\tOFFSET 0.000000 0.000000 0.000000",
        "\tCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation",
    ]
    assert "\t\tCHANNELS 3 Zrotation Xrotation Yrotation" in rows
    assert "Frame Time: 0.0333333333" in rows
    assert "-0.000000" not in rows[-1]


def test_missing_channels_of_a_hinge_or_root_are_added(tmp_path: Path) -> None:
    text = BVH_PAIR.replace("6 Xposition Yposition Zposition Zrotation", "3 Zrotation")
    text = text.replace("3 Zrotation Xrotation Yrotation\n    End", "1 Xrotation\n    End")
    text = text.replace("1 100 2 0 0 0 90 0 0\n1 100 2 0 0 90 0 0 0", "0 0 0 90\n0 0 90 0")
    _, moving = read_bvh(write(tmp_path, text))
    assert moving is not None
    np.testing.assert_allclose(moving.root_in_world_m, 0.0)
    write_bvh(tmp_path / "b.bvh", moving)
    written = (tmp_path / "b.bvh").read_text()
    assert "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation" in written
    assert "CHANNELS 3 Xrotation Zrotation Yrotation" in written
    _, back = read_bvh(tmp_path / "b.bvh")
    assert back is not None
    np.testing.assert_allclose(back.local_rotation, moving.local_rotation, atol=1e-7)


def test_position_channels_on_every_joint(tmp_path: Path) -> None:
    text = BVH_PAIR.replace("3 Zrotation", "6 Xposition Yposition Zposition Zrotation")
    held = text.replace("90 0 0\n", "21 0 0 90 0 0\n").replace("90 0 0 0\n", "90 21 0 0 0 0 0\n")
    model, moving = read_bvh(write(tmp_path, held))
    assert moving is not None
    np.testing.assert_allclose(model.offsets_m[1], [0.21, 0, 0])
    np.testing.assert_allclose(moving.local_rotation[0, 1] @ [1.0, 0, 0], [0, 0, 1], atol=1e-12)
    zero = held.replace(" 21 ", " 0 ")
    np.testing.assert_allclose(read_bvh(write(tmp_path, zero))[0].offsets_m[1], [0.2, 0, 0])


def test_metres_are_recognised(tmp_path: Path) -> None:
    text = BVH_PAIR.replace("OFFSET 20 0 0", "OFFSET 0.20 0 0").replace("1 100 2", "0.01 1.0 0.02")
    model, moving = read_bvh(write(tmp_path, text))
    assert moving is not None
    np.testing.assert_allclose(model.offsets_m[1], [0.2, 0, 0])
    np.testing.assert_allclose(moving.root_in_world_m[0], [0.01, -0.02, 1.0])


@pytest.mark.parametrize(
    ("change", "joints"),
    [
        (lambda t: t.replace("\n", "\r\n").replace("  ", "\t"), 2),
        (lambda t: "\ufeff" + t, 2),
        (lambda t: t.replace("Hips\n{", "Hips {").replace("ROOT", "Root").replace("OFFSET", "offset"), 2),
        (lambda t: t.replace("LeftArm", "Bip01 L UpperArm"), 2),
        (lambda t: t.replace("\n", "\n\n").replace("Frames: 2", "Frames:\t2"), 2),
        (lambda t: t.replace("1 100 2 0 0 0 90 0 0", "1 100 2 0 0\n0 90 0 0"), 2),
        (lambda t: t.replace("0.0333333", "0,0333333"), 2),
        (lambda t: t.replace("    End Site\n    {\n      OFFSET 30 0 0\n    }\n", ""), 2),
        (lambda t: t.replace("LeftArm", "Hips"), 2),
        (lambda t: t + "\n\n", 2),
    ],
)
def test_odd_files_are_understood(tmp_path: Path, change: object, joints: int) -> None:
    path = write(tmp_path, change(BVH_PAIR))  # type: ignore[operator]
    model, moving = read_bvh(path)
    assert moving is not None
    assert (len(model.joints), len(moving.root_in_world_m), moving.fps) == (joints, 2, 30.0)


@pytest.mark.parametrize("tail", ["", "MOTION\n", "MOTION\nFrames: 0\nFrame Time: 0.03\n"])
def test_no_motion(tmp_path: Path, tail: str) -> None:
    path = write(tmp_path, BVH_PAIR.partition("MOTION")[0] + tail)
    model, moving = read_bvh(path)
    assert model.joints == ("Hips", "LeftArm")
    assert moving is None


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("HIERARCHY", "HIERACHY", 1, "does not begin with HIERARCHY"),
        ("OFFSET 20 0 0", "OFFSET 20 0", 8, "3 numbers"),
        ("OFFSET 20 0 0", "OFFSET 20 0 x", 8, "not a number"),
        ("OFFSET 20 0 0", "OFFSET 20 0 nan", 8, "finite"),
        ("    OFFSET 20 0 0\n", "", 6, "no OFFSET"),
        ("CHANNELS 3 Z", "CHANNELS 4 Z", 9, "CHANNELS 4"),
        ("CHANNELS 3 Zrot", "CHANNELS 3 Wrot", 9, "the channel 'Wrotation' is unknown"),
        ("JOINT", "JIONT", 6, "the keyword 'JIONT' is unknown"),
        ("JOINT", "ROOT", 6, "second ROOT"),
        ("  }\n}\nMOTION", "  }\n}\n}\nMOTION", 16, "closing brace"),
        ("  }\n}\nMOTION", "  }\nMOTION", 15, "before the hierarchy is complete"),
        ("Frames: 2", "Frames: two", 17, "not a number"),
        ("Frames: 2", "Frames: 3", 20, "contains only"),
        ("Frames: 2", "Frames: 2000000000", 18, "cannot contain"),
        ("Frame Time: 0.0333333", "Frame Time: 0", 18, "positive"),
        ("1 100 2 0 0 90 0 0 0", "1 100 2 0 0 90 0 0 -1.#IND", 20, "not a number"),
        ("1 100 2 0 0 90 0 0 0", "1 100 2 0 0 90 0 0 inf", 20, "infinity"),
    ],
)
def test_broken_files_are_named(tmp_path: Path, old: str, new: str, line: int, message: str) -> None:
    assert old in BVH_PAIR
    path = write(tmp_path, BVH_PAIR.replace(old, new, 1))
    with pytest.raises(JobError, match=message) as caught:
        read_bvh(path)
    assert (caught.value.path, caught.value.line) == (str(path), line)


def test_missing_binary_and_empty_files(tmp_path: Path, rng: np.random.Generator) -> None:
    with pytest.raises(JobError, match="cannot be read"):
        read_bvh(tmp_path / "none.bvh")
    (tmp_path / "noise.bvh").write_bytes(rng.bytes(100_000))
    with pytest.raises(JobError, match="HIERARCHY"):
        read_bvh(tmp_path / "noise.bvh")
    with pytest.raises(JobError, match="HIERARCHY"):
        read_bvh(write(tmp_path, ""))


def test_a_very_deep_file_does_not_exhaust_the_stack(tmp_path: Path) -> None:
    deep = 1500  # Python's limit is 1000 calls
    blocks = [f"JOINT j{i}\n{{\nOFFSET 0 1 0\nCHANNELS 0\n" for i in range(deep)]
    text = "HIERARCHY\nROOT r\n{\nOFFSET 0 0 0\nCHANNELS 0\n" + "".join(blocks) + "}\n" * (deep + 1)
    model, _ = read_bvh(write(tmp_path, text))
    assert len(model.joints) == deep + 1


@pytest.mark.parametrize(
    ("written", "fps"),
    [
        ("0.0333333", 30.0),
        ("0.033333", 30.0),
        ("0.00833333", 120.0),
        (".008333", 120.0),
        ("0.0166667", 60.0),
        ("0.0333667", 30000 / 1001),
        ("0.016683", 60000 / 1001),
        ("0.04", 25.0),
        ("0.0317", 1 / 0.0317),
    ],
)
def test_nominal_rates(tmp_path: Path, written: str, fps: float) -> None:
    _, moving = read_bvh(write(tmp_path, BVH_PAIR.replace("0.0333333", written)))
    assert moving is not None
    assert moving.fps == pytest.approx(fps, rel=1e-12)


def test_a_full_disk_is_a_store_error_and_keeps_the_earlier_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, moving = read_bvh(write(tmp_path, BVH_PAIR))
    assert moving is not None
    (tmp_path / "a.bvh").write_text("earlier")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("bodycap_batch.formats.atomic_files.os.fsync", full)
    with pytest.raises(StoreError, match=r"No space left") as caught:
        write_bvh(tmp_path / "a.bvh", moving)
    assert "free some space" in str(caught.value.hint)
    assert (tmp_path / "a.bvh").read_text() == "earlier"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.bvh", "file.bvh"]


@pytest.mark.data
@pytest.mark.parametrize(("folder", "chest"), [("room12", "Spine1"), ("room131", "Chest2")])
def test_real_skeleton_files(data_root: Path, tmp_path: Path, folder: str, chest: str) -> None:
    path = data_root / folder / "skeleton.bvh"
    model, moving = read_bvh(path)
    assert moving is not None
    for role in ("Hips", "Spine1", "Head", "LeftArm", "LeftForeArm", "LeftHand", "RightUpLeg", "RightFoot"):
        assert model.index_of_role(role) is not None, role
    assert model.joints[model.index_of_role("Spine1") or 0] == chest
    write_bvh(tmp_path / "again.bvh", moving)
    again = [row.split() for row in (tmp_path / "again.bvh").read_text().splitlines()]
    for ours, theirs in zip(again, path.read_text().splitlines(), strict=True):
        words = theirs.split()
        if words[0] in ("ROOT", "JOINT", "CHANNELS", "{", "}", "End", "HIERARCHY"):
            assert ours == words
        elif words[0] == "OFFSET":
            assert list(map(float, ours[1:])) == list(map(float, words[1:]))


@settings(max_examples=150, deadline=None, derandomize=True)
@given(data=st.data())
def test_damaged_files_are_read_or_refused_but_never_crash(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    """The lines are deleted, repeated, swapped, cut, or changed at random."""
    lines = BVH_PAIR.encode().split(b"\n")
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(lines) - 1))
        kind = data.draw(st.sampled_from(["drop", "double", "cut", "noise", "truncate", "swap"]))
        if kind == "drop":
            del lines[at]
        elif kind == "double":
            lines.insert(at, lines[at])
        elif kind == "swap":
            lines[at], lines[-1] = lines[-1], lines[at]
        elif kind == "truncate":
            lines = lines[: at + 1]
        elif kind == "cut":
            lines[at] = lines[at][: data.draw(st.integers(0, max(0, len(lines[at]))))]
        else:
            lines[at] += data.draw(
                st.sampled_from([b" 1", b" -", b" {", b"}", b"\xff\xfe", b" 1e999", b" nan"])
            )
        lines = lines or [b""]
    path = tmp_path_factory.mktemp("fuzz") / "file.bvh"
    path.write_bytes(b"\n".join(lines))
    refused = None
    try:
        model, moving = read_bvh(path)
    except JobError as error:
        refused = error.path
    if refused is not None:
        assert refused == str(path)
        return
    assert model.joints[0]
    if moving is not None:
        assert np.isfinite(moving.world_from_joint()).all()
        write_bvh(path.with_name("again.bvh"), moving)
        again = read_bvh(path.with_name("again.bvh"), units="cm")[1]
        assert again is not None
        assert len(again.root_in_world_m) == len(moving.root_in_world_m)
