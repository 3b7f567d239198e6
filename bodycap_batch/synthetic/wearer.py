"""The surface of the wearer's body for rendering: rounded limbs that move with the joints."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.skeleton import Mount, SkeletonModel
from bodycap_batch.model.skeleton_presets import rest_positions, segment_axes, split_side
from bodycap_batch.synthetic import textures
from bodycap_batch.synthetic.pictures import WALL_PICTURES, abstract
from bodycap_batch.synthetic.triangles import UINT8, Surface, Triangles, box_faces, triangles_from_surfaces

_RADII = {
    "Hips": (0.15, 0.14),
    "Spine": (0.14, 0.145),
    "Spine1": (0.15, 0.10),
    "Neck": (0.055, 0.055),
    "Head": (0.09, 0.085),
    "Arm": (0.050, 0.040),
    "ForeArm": (0.040, 0.028),
    "Hand": (0.035, 0.022),
    "UpLeg": (0.080, 0.055),
    "Leg": (0.052, 0.035),
    "Foot": (0.035, 0.035),
    "ToeBase": (0.03, 0.02),
}
"""Radii (metres) of each limb: at the start and at the end of the limb's bone. The key is the name of the
joint at which the bone starts. Evidence: none."""
_SKIN = ("Hand", "Neck", "Head")
"""Body parts without clothes."""
_TROUSERS = ("Hips", "UpLeg", "Leg")
"""Body parts in trousers. Parts in neither `_SKIN` nor `_TROUSERS` are covered by a shirt."""
_AROUND = 14
"""Number of quadrilateral faces around a limb."""
_CAP_RINGS = 3
"""Number of rings of faces at each rounded end of a limb."""
_TEXELS_PER_M = 300.0
"""Detail (texels per metre) of the body's textures."""
_PRINT_SHARE = 0.6
"""Share of the printed pattern in the colour of patterned cloth. Evidence: none."""
_PRINT_M = 0.2
"""Side (metres) of the squares that a printed pattern consists of. All squares differ. Evidence: none."""
_BOX_M = (0.20, 0.13, 0.16)
"""Sizes (metres) of a carried box, in the frame of the hand: x, y, z."""
_BOX_AHEAD_M, _BOX_OFF_M = 0.08, 0.10
"""Position (metres) of the middle of a carried box: from the wrist along the hand, and from the hand on the
side of the palm."""
_BOX_TEXELS_PER_M = 700.0
"""Detail (texels per metre) of the pictures on a carried box, which is near the cameras."""
_CLEARANCE_M = 0.02
"""A camera outside a limb is treated as inside the limb if its distance from the limb's surface is not larger
than this threshold. Unit: metres."""


class Wearer:
    """The surface of the wearer's body, which gives the triangles to render in any pose.

    Args:
        skeleton: Skeleton with the true proportions.
        seed: Seed of the textures of clothes and skin.
        patterned: True: a pattern is printed on the clothes.
        carrying: Sides (``Left``, ``Right``) of the hands that carry a box.
    """

    def __init__(
        self,
        skeleton: SkeletonModel,
        seed: np.random.SeedSequence,
        *,
        patterned: bool = False,
        carrying: tuple[str, ...] = (),
    ) -> None:
        self._bones = _find_bones(skeleton)
        self._skeleton = skeleton
        self.images: list[UINT8] = []
        dyes = np.random.default_rng(seed.spawn(1)[0])
        shirt, trousers = (textures.colour(dyes, 0.5, (0.3, 0.6)) for _ in range(2))
        for _, start, end, radii, part in self._bones:
            rng = np.random.default_rng(seed.spawn(1)[0])
            size = float(np.linalg.norm(end - start)) + sum(radii), 2 * np.pi * max(radii)
            height, width = (max(16, round(side * _TEXELS_PER_M)) for side in size)
            dye = trousers if part in _TROUSERS else shirt
            image = _skin(height, width, rng) if part in _SKIN else _cloth(height, width, dye, rng)
            self.images.append(_print_pattern(image, rng) if patterned and part not in _SKIN else image)
        self._boxes = [_box_in_hand(skeleton, side) for side in carrying]
        for _, faces in self._boxes:
            rng = np.random.default_rng(seed.spawn(1)[0])
            for face in faces:
                tall, wide = (
                    max(16, round(float(np.linalg.norm(edge)) * _BOX_TEXELS_PER_M))
                    for edge in (face.down, face.across)
                )
                kind = WALL_PICTURES[int(rng.integers(len(WALL_PICTURES)))]
                self.images.append(np.asarray(kind(tall, wide, _BOX_TEXELS_PER_M, rng)))

    def parts(self, origins: FloatArray, mount: Mount | None = None) -> list[tuple[int, Triangles]]:
        """Return the joint of each limb, and the limb's triangles in the frame of this joint.

        Args:
            origins: (N,2) atlas coordinates (texels) of the top left corners of `images`.
            mount: Mount of the camera that sees the body. If the camera is inside the limb on which it is
                mounted, this limb is left out. Otherwise it would block the view of the camera. A real camera
                has a free view, because its housing presses the cloth in.
        """
        out = []
        own = None if mount is None else self._skeleton.index_of_role(mount.role)
        for index, (joint, start, end, radii, _) in enumerate(self._bones):
            if (
                mount is None
                or joint != own
                or not _is_inside(mount.joint_from_cam[:3, 3], start, end, radii)
            ):
                shape = _rounded_cone(start, end, radii, self.images[index], origins[index], index)
                out.append((joint, shape))
        used = len(self._bones)
        for joint, faces in self._boxes:
            pictures = self.images[used : used + len(faces)]
            sides = [replace(face, image=image) for face, image in zip(faces, pictures, strict=True)]
            shape = triangles_from_surfaces(sides, origins[used : used + len(faces)])
            out.append((joint, replace(shape, surface=shape.surface + used)))
            used += len(faces)
        return out


def _box_in_hand(skeleton: SkeletonModel, side: str) -> tuple[int, list[Surface]]:
    """Return the joint of a hand, and the faces of a box in front of its palm, without pictures."""
    joint = skeleton.index_of_role(f"{side}Hand")
    along, _, outward = segment_axes(skeleton, f"{side}Hand").T
    assert joint is not None  # The built-in body has hands.
    centre = _BOX_AHEAD_M * along - _BOX_OFF_M * outward
    return joint, box_faces(centre, _BOX_M, 0.0)


_Bone = tuple[int, FloatArray, FloatArray, tuple[float, float], str]
"""A bone: joint index, start and end in the joint's frame (m), radii at both ends (m), name of the body part.
"""


def _find_bones(skeleton: SkeletonModel) -> list[_Bone]:
    """Return the bones of a skeleton that have a surface."""
    rest, out = rest_positions(skeleton), []
    for joint, role in enumerate(skeleton.roles):
        part = split_side(role)[1]
        if part not in _RADII:
            continue
        end = skeleton.end_offsets_m[joint]
        children = np.flatnonzero(skeleton.parents == joint)
        if len(children):
            # A bone of the trunk ends at the child joint straight above. A bone of a limb ends at its only
            # child joint.
            ahead = rest[children] - rest[joint]
            end = ahead[np.argmin(np.abs(ahead[:, 0]))]
        if np.isfinite(end).all() and np.linalg.norm(end) > 0.01:
            out.append((joint, np.zeros(3), np.asarray(end), _RADII[part], part))
    return out


def _is_inside(point: FloatArray, start: FloatArray, end: FloatArray, radii: tuple[float, float]) -> bool:
    """Return True if a point (3,) is inside a limb between two points (3,), or near its surface."""
    ratio = np.clip((point - start) @ (end - start) / ((end - start) @ (end - start)), 0, 1)
    return bool(np.linalg.norm(point - start - ratio * (end - start)) <= max(radii) + _CLEARANCE_M)


def _rounded_cone(
    start: FloatArray,
    end: FloatArray,
    radii: tuple[float, float],
    image: UINT8,
    origin: FloatArray,
    index: int,
) -> Triangles:
    """Return the triangles of a rounded cone, with an image wrapped around the cone.

    Args:
        start: (3,) start of the cone's axis (m).
        end: (3,) end of the cone's axis (m).
        radii: Radii (m) at start and end.
        image: (H,W,3) RGB texture.
        origin: (2,) atlas coordinates (texels) of the image's top left corner.
        index: Number of the surface.
    """
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    rings = []
    for angle in np.linspace(-np.pi / 2, 0, _CAP_RINGS + 1):
        rings.append((start + axis * radii[0] * np.sin(angle), radii[0] * max(np.cos(angle), 1e-3)))
    for angle in np.linspace(0, np.pi / 2, _CAP_RINGS + 1):
        rings.append((end + axis * radii[1] * np.sin(angle), radii[1] * max(np.cos(angle), 1e-3)))
    turn = np.linspace(0, 2 * np.pi, _AROUND + 1)
    circle = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other
    vertices = np.array([centre + radius * circle for centre, radius in rings])
    rows, columns = vertices.shape[:2]
    # The image is spread evenly over the surface from pole to pole.
    lengths = np.linalg.norm(np.diff(vertices[:, 0], axis=0), axis=1)
    heights = np.concatenate([[0.0], np.cumsum(lengths)]) / lengths.sum()
    v, u = np.meshgrid(0.01 + 0.98 * heights, np.linspace(0.01, 0.99, columns), indexing="ij")
    texels = origin + np.stack([u * image.shape[1], v * image.shape[0]], axis=-1)
    ids = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = ids[:-1, :-1], ids[:-1, 1:], ids[1:, 1:], ids[1:, :-1]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return _textured_triangles(vertices.reshape(-1, 3), texels.reshape(-1, 2), faces, index)


def _textured_triangles(vertices: FloatArray, texels: FloatArray, faces: FloatArray, index: int) -> Triangles:
    """Return triangles with their planes and texture gradients.

    Args:
        vertices: (V,3) positions of the vertices (m).
        texels: (V,2) atlas coordinates (texels) of the vertices.
        faces: (F,3) vertex indices of the triangles. Triangles without area are removed.
        index: Number of the surface.
    """
    corner = vertices[faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    normal = np.cross(first, second)
    area2 = (normal**2).sum(axis=1)
    keep = area2 > 1e-16
    corner, first, second, normal, area2 = (part[keep] for part in (corner, first, second, normal, area2))
    at = texels[faces[keep]]
    step_first, step_second = at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]
    along, across = np.cross(second, normal), np.cross(normal, first)
    gradient = step_first[:, :, None] * along[:, None] + step_second[:, :, None] * across[:, None]
    return Triangles(
        vertices=vertices,
        faces=faces[keep].astype(np.uint32),
        normal=normal / np.sqrt(area2)[:, None],
        point=corner[:, 0],
        texel_at_point=at[:, 0],
        texels_per_m=gradient / area2[:, None, None],
        plane=np.arange(int(keep.sum())),
        surface=np.full(int(keep.sum()), index),
    )


def _skin(height: int, width: int, rng: np.random.Generator) -> UINT8:
    """Return a texture of skin."""
    shade = 0.85 + 0.03 * textures.fractal(height, width, 20.0, rng, 3)
    return textures.tint_shade(shade, np.array([222, 170, 140], np.float32))


def _cloth(height: int, width: int, dye: textures.Grey, rng: np.random.Generator) -> UINT8:
    """Return a texture of cloth in the colour `dye`."""
    folds = 0.9 + 0.12 * textures.fractal(height, width, 40.0, rng, 4)
    weave = 0.05 * rng.standard_normal((height, width), dtype=np.float32)
    return textures.tint_shade(folds + weave, dye)


def _print_pattern(cloth: UINT8, rng: np.random.Generator) -> UINT8:
    """Return cloth (H,W,3) with a printed pattern: shapes of different sizes and colours."""
    side = round(_PRINT_M * _TEXELS_PER_M)
    printed = np.empty_like(cloth)
    for top in range(0, cloth.shape[0], side):
        for left in range(0, cloth.shape[1], side):
            part = printed[top : top + side, left : left + side]
            part[:] = abstract(side, side, _TEXELS_PER_M, rng)[: part.shape[0], : part.shape[1]]
    return np.asarray(cv2.addWeighted(cloth, 1.0 - _PRINT_SHARE, printed, _PRINT_SHARE, 0.0))
