"""Put the motion of a results folder onto another character in Blender, for example a Rigify metarig.

    blender --background --python examples/blender_retarget.py -- out/my_walk scene.blend

This makes a human metarig (Rigify) and animates it. In a script of your own, call `retarget` with your
armature and a table of its bone names. Rotations are copied relative to the rest poses; the path is scaled by
the length of the legs; feet and hands are placed by two-bone inverse kinematics, with knees and elbows in the
planes of the recorded ones. Blender 4.2 and later.
"""

import json
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

FORWARD, BACKWARD = Vector((0.0, -1.0, 0.0)), Vector((0.0, 1.0, 0.0))

METARIG = {
    "Hips": "spine", "Spine": "spine.001", "Spine1": "spine.003", "Neck": "spine.004", "Head": "spine.006",
    **{
        f"{side}{role}": f"{bone}.{side[0]}"
        for side in ("Left", "Right")
        for role, bone in (
            ("Shoulder", "shoulder"), ("Arm", "upper_arm"), ("ForeArm", "forearm"), ("Hand", "hand"),
            ("UpLeg", "thigh"), ("Leg", "shin"), ("Foot", "foot"), ("ToeBase", "toe"),
        )
    },
}  # fmt: skip
"""Bone of Rigify's human metarig for each role of our skeleton."""

MIXAMO = {
    "Hips": "mixamorig:Hips", "Spine": "mixamorig:Spine", "Spine1": "mixamorig:Spine2",
    "Neck": "mixamorig:Neck", "Head": "mixamorig:Head",
    **{
        f"{side}{role}": f"mixamorig:{side}{role}"
        for side in ("Left", "Right")
        for role in ("Shoulder", "Arm", "ForeArm", "Hand", "UpLeg", "Leg", "Foot", "ToeBase")
    },
}  # fmt: skip
"""Bone of a Mixamo character for each role of our skeleton."""


class Retarget:
    """The rest poses of two armatures, and what follows from them.

    Args:
        source: The armature with the recorded motion, with our names (HumanIK).
        target: The armature to animate, with neither rotation nor scale.
        names: Bone of the target for each role. Roles without a bone are left out.
    """

    def __init__(self, source, target, names):
        self.source, self.target, self.names = source, target, names
        self.from_rest = {role: self._rest(source, role).to_3x3() for role in names}
        bones = target.data.bones
        self.order = [bone for bone in bones if bone.name in set(names.values()) or _above(bone, names)]
        self.role_of = {name: role for role, name in names.items()}
        own = {role: role for role in names}
        legs, arms = ("UpLeg", "Leg", "Foot"), ("Arm", "ForeArm", "Hand")
        self.scale, self.arm_scale = (
            self._length(target, names, roles) / self._length(source, own, roles) for roles in (legs, arms)
        )
        self.lift = self._ankle(target, names) - self.scale * self._ankle(source, own)
        self.aligned = {role: self._alignment(role) for role in names}

    @staticmethod
    def _rest(armature, bone):
        return armature.matrix_world @ armature.data.bones[bone].matrix_local

    def _length(self, armature, names, roles):
        """Length of a limb's two bones."""
        first, middle, last = (self._rest(armature, names[f"Left{role}"]).translation for role in roles)
        return (middle - first).length + (last - middle).length

    def _ankle(self, armature, names):
        return self._rest(armature, names["LeftFoot"]).translation.z

    def _direction(self, armature, names, role):
        """Direction of a limb's bone at rest."""
        side = "Left" if role.startswith("Left") else "Right"
        after = {"Arm": "ForeArm", "ForeArm": "Hand", "UpLeg": "Leg", "Leg": "Foot"}.get(
            role.removeprefix(side)
        )
        start = self._rest(armature, names[role])
        if after is None:
            bone = armature.data.bones[names[role]]
            return (armature.matrix_world.to_3x3() @ (bone.tail_local - bone.head_local)).normalized()
        return (self._rest(armature, names[side + after]).translation - start.translation).normalized()

    def _alignment(self, role):
        """Rotation that brings the target's rest pose (perhaps an A-pose) to the source's T-pose."""
        if not role.endswith(("Arm", "Hand")):
            return Matrix.Identity(3)
        own = {each: each for each in self.names}
        ours, theirs = (
            self._direction(self.target, self.names, role), self._direction(self.source, own, role)
        )  # fmt: skip
        return ours.rotation_difference(theirs).to_matrix()

    def turned(self, role):
        """Rotation of a source bone away from its rest pose, in the world."""
        pose = self.source.matrix_world @ self.source.pose.bones[role].matrix
        return pose.to_3x3() @ self.from_rest[role].inverted()

    def at(self, role):
        """Place of a source joint in the world, scaled to the target."""
        return self.scale * self._place(role) + Vector((0.0, 0.0, self.lift))

    def goal(self, role, shoulder=None):
        """Place that the end of a limb should reach.

        A foot goes where the source's is, scaled by the legs. A hand keeps its place to the middle of the
        shoulders, scaled by the arms, since trunks and arms have other ratios than legs; `shoulder` is the
        place of the target's shoulder.
        """
        if shoulder is None:
            return self.at(role)
        side, other = ("Left", "Right") if role.startswith("Left") else ("Right", "Left")
        ours = [self._rest(self.target, self.names[f"{each}Arm"]).translation for each in (side, other)]
        theirs = [self._place(f"{each}Arm") for each in (side, other)]
        half = (theirs[1] - theirs[0]).normalized() * (ours[1] - ours[0]).length / 2.0
        return shoulder + half + self.arm_scale * (self._place(role) - (theirs[0] + theirs[1]) / 2.0)

    def _place(self, role):
        """Place of a source joint in the world."""
        return (self.source.matrix_world @ self.source.pose.bones[role].matrix).translation

    def pose(self):
        """Return the pose of each bone of the target in the world, for the current frame."""
        poses = {}
        limbs = {}
        for bone in self.order:
            rest = self.target.matrix_world @ bone.matrix_local
            role = self.role_of.get(bone.name)
            if bone.parent is None or bone.parent.name not in poses:
                place = rest
            else:
                parent = self.target.matrix_world @ bone.parent.matrix_local
                place = poses[bone.parent.name] @ parent.inverted() @ rest
            if role is None:
                poses[bone.name] = place
                continue
            turn = self.turned(role) @ self.aligned[role] @ rest.to_3x3()
            if role in limbs:
                turn = limbs[role] @ rest.to_3x3()
            spot = place.translation
            if role == "Hips":
                spot = self._root(turn @ rest.to_3x3().inverted(), rest)
            for end, pole in (("Arm", BACKWARD), ("UpLeg", FORWARD)):
                if role in (f"Left{end}", f"Right{end}"):
                    first, second = self._two_bones(role, spot, pole)
                    limbs[role.replace(end, {"Arm": "ForeArm", "UpLeg": "Leg"}[end])] = second
                    turn = first @ rest.to_3x3()
            poses[bone.name] = Matrix.Translation(spot) @ turn.to_4x4()
        return poses

    def _root(self, turn, rest):
        """Place of the pelvis bone: the middle of the hip joints is where the source's is, scaled."""
        thighs = [
            self._rest(self.target, self.names[f"{side}UpLeg"]).translation for side in ("Left", "Right")
        ]
        middle = (thighs[0] + thighs[1]) / 2.0
        wanted = (self.at("LeftUpLeg") + self.at("RightUpLeg")) / 2.0
        return wanted - turn @ (middle - rest.translation)

    def _two_bones(self, role, start, pole):
        """Rotations away from rest of the two bones of a limb that ends at the source's place.

        The joint in between lies on the side of `pole`, turned with the source's upper bone.
        """
        side = "Left" if role.startswith("Left") else "Right"
        middle, end = ("ForeArm", "Hand") if role.endswith("Arm") else ("Leg", "Foot")
        names = self.names
        rests = [
            self._rest(self.target, names[each]).translation for each in (role, side + middle, side + end)
        ]
        upper, lower = (rests[1] - rests[0]).length, (rests[2] - rests[1]).length
        way = self.goal(side + end, start if end == "Hand" else None) - start
        reach = min(max(way.length, abs(upper - lower) + 1e-4), 0.9995 * (upper + lower))
        along = way.normalized()
        front = self.turned(role) @ pole
        front = (front - front.dot(along) * along).normalized()
        cosine = (upper**2 + reach**2 - lower**2) / (2.0 * upper * reach)
        sine = max(0.0, 1.0 - cosine**2) ** 0.5
        knee = start + upper * (cosine * along + sine * front)
        tip = start + reach * along
        own = self.aligned[role].inverted() @ pole
        turns = []
        for line, rest in (((knee - start), rests[1] - rests[0]), ((tip - knee), rests[2] - rests[1])):
            turns.append(_frame(line, front) @ _frame(rest, own).inverted())
        return turns


def _above(bone, names):
    """True if a bone stands between mapped bones, so that its children need its pose."""
    return any(child.name in set(names.values()) for child in bone.children_recursive)


def _frame(line, front):
    """Matrix whose first column is a direction and whose second column is as near `front` as possible."""
    first = line.normalized()
    second = (front - front.dot(first) * first).normalized()
    return Matrix((first, second, first.cross(second))).transposed()


def retarget(source, target, names, first, last):
    """Key the pose of a target armature at each frame of the source's motion."""
    work = Retarget(source, target, names)
    scene = bpy.context.scene
    previous = {}
    for frame in range(first, last + 1):
        scene.frame_set(frame)
        poses = work.pose()
        for bone in work.order:
            posed = target.pose.bones[bone.name]
            rest = bone.matrix_local
            if bone.parent is not None and bone.parent.name in poses:
                rest = bone.parent.matrix_local.inverted() @ rest
                above = poses[bone.parent.name]
            else:
                above = target.matrix_world
            basis = rest.inverted() @ above.inverted() @ poses[bone.name]
            turn = basis.to_quaternion()
            if bone.name in previous:
                turn.make_compatible(previous[bone.name])
            previous[bone.name] = turn
            posed.rotation_mode = "QUATERNION"
            posed.rotation_quaternion = turn
            posed.keyframe_insert("rotation_quaternion", frame=frame)
            if work.role_of.get(bone.name) == "Hips":
                posed.location = basis.translation
                posed.keyframe_insert("location", frame=frame)
    return work


def import_body(folder):
    """Import the body of a results folder with the script that stands beside it, and return its armature."""
    sys.path.insert(0, str(folder))
    import blender_scene

    blender_scene.build_scene(folder)
    return bpy.data.objects["Body"]


def main(folder, blend):
    """Animate a Rigify metarig with the motion of a results folder, and save the file."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    body = import_body(folder)
    bpy.ops.preferences.addon_enable(module="rigify")
    bpy.ops.object.armature_human_metarig_add()
    target = bpy.context.object
    scene = bpy.context.scene
    retarget(body, target, METARIG, scene.frame_start, scene.frame_end)
    bpy.ops.wm.save_as_mainfile(filepath=str(blend.resolve()))
    print(json.dumps({"bones": len(METARIG), "frames": scene.frame_end - scene.frame_start + 1}))


if __name__ == "__main__":
    words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    main(Path(words[0]).resolve(), Path(words[1]))
