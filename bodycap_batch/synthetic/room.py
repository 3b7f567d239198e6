"""A laboratory: walls, floor, ceiling, furniture, and pictures on the walls.

Each surface has a different texture from a separate random stream, unless repeated posters are requested. As
in a real room, parts of the walls and most of the ceiling have little texture.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from bodycap_batch.core.arrays import FloatArray
from bodycap_batch.model.geometry import so3_exp
from bodycap_batch.synthetic import pictures, textures
from bodycap_batch.synthetic.lighting import light_surfaces
from bodycap_batch.synthetic.options import SynthOptions
from bodycap_batch.synthetic.textures import Texture
from bodycap_batch.synthetic.triangles import UINT8, Surface, box_faces, surface_facing

_PICTURE_DETAIL = 1.3
"""Ratio of the texture detail (texels per metre) of pictures and books to the detail of walls and furniture.
"""
_EDGE_M = 0.06
"""Minimum width (metres) of a face with its material's texture. A narrower face, such as the edge of a board,
gets a texture of painted metal."""
_MAX_TEXELS = 6000
"""Maximum length (texels) of the longer side of a texture. The limit saves memory."""
HEIGHT_M = 2.8
"""Height of the room, metres."""
MARGIN_M = 1.7
"""Minimum distance (metres) between the walk and the walls. Furniture at the walls is up to 0.7 m deep."""
_MIN_HALF_M = (3.4, 3.0)
"""Minimum distances (metres) from the room's middle to the walls along x and y."""
_CARPETS = ((-0.38, -0.35), (0.42, 0.30), (-0.25, 0.45), (0.4, -0.5))
"""Centres (x, y) of the carpets. The value 0 is the room's middle, and the values −1 and 1 are the walls."""
_WALL_NAMES = ("north", "east", "south", "west")
"""Names of the walls in the directions +y, +x, -y and -x from the room's middle, in the order of
`_build_shell`."""
_FLAT_PICTURE_M = (0.3, 0.9)
"""Minimum and maximum side (metres) of a flat picture on a plain surface. Evidence: none."""
_FLAT_PICTURE_SPREAD = 0.7
"""Maximum distance of a flat picture from the middle of its surface, as a fraction of half the surface."""
_FLAT_PICTURE_OFF_M = 0.012
"""Distance (metres) of a flat picture from its surface."""
_BAY_M = 1.8
"""Length (metres) of one of the identical bays along a wall: a shelf and the pictures above it."""
_PARTITION_M = 0.12
"""Thickness (metres) of the wall between two rooms."""
_OPENING_M = (0.2, 1.95)
"""Distances (metres) of the sides of the two openings from the middle of the wall between two rooms. The
built-in walk passes it at 0.7 m and at 1.4 m."""
_OPENING_TOP_M = 2.15
"""Height (metres) of the openings."""
_TABLE = (0.0, 0.62)
"""Middle (x, y; metres) of the table in front of a person who stands still. The person faces +y."""
_TABLE_TOP_M = 0.98
"""Height (metres) of the table for a person who stands."""
_PICTURE_BASES_M = (2.05, 1.25, 1.55, 1.10)
"""Minimum height (metres) of the lower edges of pictures, for each of the four walls. The pictures are above
the furniture at the wall."""


@dataclass(slots=True)
class _Builder:
    """Collect the surfaces of a room while the room is built.

    Each random texture uses the next child of one seed sequence.

    Attributes:
        seeds: Seed sequence of all random streams.
        texels_per_m: Detail of the textures, texels per metre.
        texture: Contrast of the textures of `textured`, and density of the pictures on the walls, 0 to 1.
        surfaces: The surfaces that have been added so far.
    """

    seeds: np.random.SeedSequence
    texels_per_m: float
    texture: float = 1.0
    surfaces: list[Surface] = field(default_factory=list)

    def rng(self) -> np.random.Generator:
        """Return a generator with the next random stream."""
        return np.random.default_rng(self.seeds.spawn(1)[0])

    def image(self, size_m: tuple[float, float], texture: Texture, detail: float = 1.0) -> UINT8:
        """Return a new image of a texture for a rectangle.

        Args:
            size_m: Width and height of the rectangle, metres.
            texture: Function that draws the texture.
            detail: Multiplier of the texture detail.
        """
        scale = min(self.texels_per_m * detail, _MAX_TEXELS / max(size_m))
        width, height = (max(8, round(side * scale)) for side in size_m)
        return np.asarray(texture(height, width, scale, self.rng()), dtype=np.uint8)

    def textured(self, face: Surface, texture: Texture, detail: float = 1.0) -> None:
        """Add a face with a new image of a texture. Narrow faces get a metal texture."""
        size = face.size_m
        if min(size) < _EDGE_M:
            texture = textures.metal
        image = self.image(size, texture, detail)
        if self.texture < 1.0:
            image = textures.faded(image, self.texture, self.texels_per_m, self.rng())
        self.surfaces.append(replace(face, image=image))

    def box(self, centre: FloatArray, size_m: npt.ArrayLike, yaw_deg: float, texture: Texture) -> None:
        """Add the visible faces of a box, each with a new image of a texture.

        The bottom is visible only if it is above the floor.
        """
        visible = 6 if centre[2] - np.asarray(size_m)[2] / 2 > 0.05 else 5
        for face in box_faces(centre, size_m, yaw_deg)[:visible]:
            self.textured(face, texture)


@dataclass(frozen=True, slots=True)
class _Wall:
    """One wall of the room. It gives world positions for the objects at the wall.

    Attributes:
        middle: (3,) world position (m) of the wall's middle at floor height.
        right: (3,) horizontal unit vector along the wall, to the right for a person who looks at the wall.
        normal: (3,) unit normal of the wall. It points into the room.
        length_m: Length of the wall, metres.
    """

    middle: FloatArray
    right: FloatArray
    normal: FloatArray
    length_m: float

    def point_at(self, along_m: float, height_m: float, off_m: float) -> FloatArray:
        """Return a world position (3,) in metres.

        Args:
            along_m: Distance to the right of the wall's middle, metres.
            height_m: Height above the floor, metres.
            off_m: Distance in front of the wall, metres.
        """
        point = self.middle + along_m * self.right + off_m * self.normal
        return np.asarray(point + np.array([0.0, 0.0, height_m]))

    @property
    def yaw_deg(self) -> float:
        """Angle (degrees) of `right` about the vertical, measured from the x axis."""
        return float(np.degrees(np.arctan2(self.right[1], self.right[0])))


def build_room(
    half_extent_m: tuple[float, float],
    texels_per_m: float,
    seed: np.random.SeedSequence,
    options: SynthOptions,
) -> list[Surface]:
    """Build a furnished and lit room around a walk.

    Args:
        half_extent_m: Maximum distances (metres) of the walk from the room's middle along x and y.
        texels_per_m: Detail of the textures, texels per metre.
        seed: Seed of all textures and positions.
        options: What the room contains, what repeats in it, and how much texture there is.

    Returns:
        The surfaces of the room. Their textures include the light of the lamps.
    """
    half = half_size_m(half_extent_m)
    bare = frozenset[str](options.bare)
    if options.room == "bays_90":
        half = [max(half)] * 2
    build = _Builder(seed, texels_per_m, options.texture)
    plain = bare if options.furnished else bare | {"ceiling", "floor", "east"}
    walls = _build_shell(build, half, plain)
    furnish = (_add_shelves, _add_desks, _add_cupboards, _add_sofa)
    for name, wall, furniture in zip(_WALL_NAMES, walls, furnish, strict=True):
        if options.furnished and name not in bare and options.room == "single":
            furniture(build, wall)
    if options.still:
        _add_table(build)
    if options.room != "single":
        return _with_repeats(build, walls, half, options.room)
    _add_pictures(build, walls, options.repeated_posters, bare)
    if "ceiling" not in plain:
        _add_ceiling_fittings(build, half)
    _add_flat_pictures(build, half, walls, options)
    return _lit(build, half)


def _lit(build: _Builder, half: list[float]) -> list[Surface]:
    """Add lamps, and return all surfaces with the light on them."""
    rng = build.rng()
    count = max(2, round(half[0] / 1.7)), max(2, round(half[1] / 1.7))
    grid = np.meshgrid(*(np.linspace(-0.6, 0.6, n) * side for n, side in zip(count, half, strict=True)))
    lamps = np.stack([grid[0].ravel(), grid[1].ravel(), np.full(grid[0].size, HEIGHT_M - 0.12)], axis=-1)
    _add_lamp_housings(build, lamps)
    return light_surfaces(build.surfaces, lamps, rng)


def half_size_m(half_extent_m: tuple[float, float]) -> list[float]:
    """Return half of the room's size (metres) along x and y.

    Args:
        half_extent_m: Maximum distances (metres) of the walk from the room's middle along x and y.
    """
    return [max(low, extent + MARGIN_M) for low, extent in zip(_MIN_HALF_M, half_extent_m, strict=True)]


def _build_shell(build: _Builder, half: list[float], plain: frozenset[str]) -> list[_Wall]:
    """Add floor, carpets, ceiling and four walls, and return the walls.

    Args:
        build: Collector of the surfaces.
        half: Half of the room's size along x and y, metres.
        plain: Names of the plain surfaces. There are no carpets on a plain floor.
    """
    up = np.array([0.0, 0.0, 1.0])
    floor, ceiling = _floor_and_ceiling(half)
    build.textured(floor, textures.plaster if "floor" in plain else textures.planks)
    build.textured(ceiling, textures.plaster if "ceiling" in plain else textures.ceiling_panels)
    rng = build.rng()
    for x, y in () if "floor" in plain else _CARPETS:
        size = (rng.uniform(1.3, 2.2), rng.uniform(1.0, 1.6), 0.012)
        centre = np.array([x * half[0], y * half[1], size[2] / 2])
        texture = textures.carpet if rng.uniform() < 0.75 else textures.tiles
        build.textured(box_faces(centre, size, float(rng.uniform(-25, 25)))[4], texture)
    walls = []
    for name, angle in zip(_WALL_NAMES, (90, 0, 270, 180), strict=True):
        # The wall is in the direction `outward` from the room's middle, and faces the middle.
        outward = np.round([np.cos(np.radians(angle)), np.sin(np.radians(angle)), 0.0], 12)
        axis = int(np.argmax(np.abs(outward)))
        wall = _Wall(outward * half[axis], np.cross(up, -outward), -outward, 2 * half[1 - axis])
        walls.append(wall)
        has_bricks = name == "east" and name not in plain
        build.textured(_face_of(wall), textures.bricks if has_bricks else textures.plaster)
    return walls


def _floor_and_ceiling(half: list[float]) -> list[Surface]:
    """Return the floor and the ceiling of a room, whose images are inside, without images."""
    ceiling, floor = box_faces([0, 0, HEIGHT_M / 2], [2 * half[0], 2 * half[1], HEIGHT_M], 0.0)[4:]
    return [replace(face, corner=face.corner + face.across, across=-face.across) for face in (floor, ceiling)]


def _add_shelves(build: _Builder, wall: _Wall) -> None:
    """Add open shelves with books along a wall."""
    rng = build.rng()
    for along in np.arange(-wall.length_m / 2 + 0.9, wall.length_m / 2 - 0.8, 1.75):
        wide, deep, tall = rng.uniform(0.9, 1.3), 0.32, rng.uniform(1.3, 2.1)
        for side in (-1, 1):
            upright = wall.point_at(along + side * wide / 2, tall / 2, deep / 2)
            build.box(upright, (0.03, deep, tall), wall.yaw_deg, textures.planks)
        boards = np.linspace(0.06, tall - 0.02, int(tall / 0.36) + 1)
        for low, high in pairwise(boards):
            build.box(wall.point_at(along, low, deep / 2), (wide, deep, 0.03), wall.yaw_deg, textures.planks)
            space = high - low - 0.05
            depth = rng.uniform(0.16, 0.28)
            face = surface_facing(
                wall.point_at(along, low + 0.02 + space / 2, depth), wall.normal, (wide - 0.05, space), _BLANK
            )
            build.textured(face, pictures.books, _PICTURE_DETAIL)
        build.box(
            wall.point_at(along, boards[-1], deep / 2), (wide, deep, 0.03), wall.yaw_deg, textures.planks
        )
        if rng.uniform() < 0.7:
            size = (rng.uniform(0.25, 0.5), 0.26, rng.uniform(0.18, 0.35))
            centre = wall.point_at(along + rng.uniform(-0.2, 0.2), tall + size[2] / 2, deep / 2)
            build.box(centre, size, wall.yaw_deg + rng.uniform(-15, 15), pictures.cardboard)


def _add_desks(build: _Builder, wall: _Wall) -> None:
    """Add desks with monitors and boxes along a wall."""
    rng = build.rng()
    for along in np.arange(-wall.length_m / 2 + 1.2, wall.length_m / 2 - 0.9, 2.0):
        wide, deep = rng.uniform(1.4, 1.7), 0.68
        top = textures.granite if rng.uniform() < 0.5 else textures.planks
        build.box(wall.point_at(along, 0.72, deep / 2), (wide, deep, 0.04), wall.yaw_deg, top)
        for side in (-1, 1):
            leg = wall.point_at(along + side * (wide / 2 - 0.25), 0.35, deep / 2)
            build.box(leg, (0.42, deep - 0.1, 0.70), wall.yaw_deg, textures.metal)
        size = (rng.uniform(0.5, 0.65), rng.uniform(0.3, 0.38))
        turn = wall.yaw_deg + rng.uniform(-20, 20)
        centre = wall.point_at(along + rng.uniform(-0.25, 0.25), 0.86 + size[1] / 2, 0.3)
        build.box(centre, (size[0], 0.04, size[1]), turn, pictures.screen)
        build.box(centre - [0, 0, 0.06 + size[1] / 2], (0.2, 0.2, 0.12), turn, textures.metal)
        for _ in range(3):
            block = rng.uniform(0.10, 0.24, 3)
            spot = wall.point_at(
                along + rng.uniform(-0.5, 0.5) * wide, 0.74 + block[2] / 2, rng.uniform(0.35, 0.6)
            )
            build.box(spot, block, float(rng.uniform(0, 90)), pictures.cardboard)


def _add_cupboards(build: _Builder, wall: _Wall) -> None:
    """Add cupboards of different heights along a wall, with boxes on top."""
    rng = build.rng()
    for along in np.arange(-wall.length_m / 2 + 0.7, wall.length_m / 2 - 0.6, 1.25):
        wide, deep, tall = rng.uniform(0.7, 1.0), rng.uniform(0.4, 0.6), rng.uniform(0.7, 1.5)
        texture = (textures.metal, textures.planks, pictures.whiteboard)[int(rng.integers(3))]
        build.box(wall.point_at(along, tall / 2, deep / 2), (wide, deep, tall), wall.yaw_deg, texture)
        size = (rng.uniform(0.25, 0.5), rng.uniform(0.2, 0.35), rng.uniform(0.15, 0.4))
        spot = wall.point_at(along + rng.uniform(-0.2, 0.2), tall + size[2] / 2, deep / 2)
        build.box(spot, size, wall.yaw_deg + rng.uniform(-30, 30), pictures.cardboard)


def _add_sofa(build: _Builder, wall: _Wall) -> None:
    """Add a sofa, a pile of boxes and a partition at a wall."""
    rng = build.rng()
    for place, size in (
        ((-0.9, 0.22, 0.42), (1.9, 0.8, 0.42)),
        ((-0.9, 0.62, 0.12), (1.9, 0.22, 0.40)),
        *(((-0.9 + side * 0.85, 0.53, 0.45), (0.2, 0.75, 0.2)) for side in (-1, 1)),
    ):
        build.box(wall.point_at(*place), size, wall.yaw_deg, textures.fabric)
    height = 0.0
    for _ in range(4):
        size = (rng.uniform(0.45, 0.65), rng.uniform(0.4, 0.55), rng.uniform(0.25, 0.4))
        spot = wall.point_at(0.75 + rng.uniform(-0.05, 0.05), height + size[2] / 2, 0.35)
        build.box(spot, size, wall.yaw_deg + rng.uniform(-12, 12), pictures.cardboard)
        height += size[2]
    partition = wall.point_at(min(2.0, wall.length_m / 2 - 0.9), 0.85, 0.35)
    build.box(partition, (1.1, 0.05, 1.7), wall.yaw_deg + 15.0, pictures.notes)


def _add_pictures(build: _Builder, walls: list[_Wall], repeated: bool, bare: frozenset[str]) -> None:
    """Add whiteboards, posters and paintings above the furniture. Some parts of the walls stay bare.

    The walls that `bare` names get no pictures.
    """
    rng = build.rng()
    kinds = list(pictures.WALL_PICTURES)
    repeats = [build.image((0.6, 0.8), kind, _PICTURE_DETAIL) for kind in kinds[:3]]
    for index, wall in enumerate(walls):
        if _WALL_NAMES[index] in bare:
            continue
        # The first wall has shelves up to 2.1 m high. So its pictures hang higher and are less tall.
        along = -wall.length_m / 2 + 0.3
        while along < wall.length_m / 2 - 0.7:
            wide, tall = float(rng.uniform(0.45, 1.1)), float(rng.uniform(0.45, 0.95))
            base = _PICTURE_BASES_M[index] + float(rng.uniform(0, 0.25))
            tall = min(tall, HEIGHT_M - 0.08 - base)
            if along + wide > wall.length_m / 2 - 0.1:
                break
            if rng.uniform() < 0.85 * build.texture:
                kind = kinds[int(rng.integers(len(kinds)))]
                if index == 1 and wide > 0.9:
                    kind = pictures.whiteboard
                image = build.image((wide, tall), kind, _PICTURE_DETAIL)
                if repeated:
                    image, (wide, tall) = repeats[int(rng.integers(len(repeats)))], (0.6, 0.8)
                centre = wall.point_at(along + wide / 2, base + tall / 2, 0.012)
                build.surfaces.append(surface_facing(centre, wall.normal, (wide, tall), image))
            along += wide + float(rng.uniform(0.12, 0.5))


def _with_repeats(build: _Builder, walls: list[_Wall], half: list[float], repeats: str) -> list[Surface]:
    """Furnish a room with identical parts, and return all lit surfaces.

    Args:
        build: Collector of the surfaces. It holds the shell, and a table if there is one.
        walls: The walls.
        half: Half of the room's size along x and y, metres.
        repeats: Kind of the identical parts.
    """
    shell, build.surfaces = build.surfaces, []
    furnish = (_add_shelves, _add_desks, _add_cupboards, _add_sofa)
    if repeats == "bays_along":
        for wall, furniture in list(zip(walls, furnish, strict=True))[1:]:
            furniture(build, wall)
        _add_pictures(build, walls, repeated=False, bare=frozenset({"north"}))
        shell, build.surfaces = shell + build.surfaces, []
        count = int(walls[0].length_m / _BAY_M)
        bay = replace(walls[0], length_m=_BAY_M)
        _add_shelves(build, bay)
        _add_pictures(build, [bay], repeated=False, bare=frozenset())
        shifts = (np.arange(count) - (count - 1) / 2) * _BAY_M
        copies = [_shifted(face, shift * bay.right) for shift in shifts for face in build.surfaces]
    else:
        # Carpets would make the parts unlike; floor and ceiling are made alike by turning their images.
        quarters = (0, 1, 2, 3) if repeats == "bays_90" else (0, 2)
        flat = [face for face in shell if abs(face.normal[2]) > 0.5 and np.linalg.norm(face.across) > half[0]]
        table = shell[2 + len(_CARPETS) + len(walls) :]
        shell = [replace(face, image=_turned_alike(face.image, len(quarters))) for face in flat] + table
        for index in range(4 // len(quarters)):
            build.textured(_face_of(walls[index]), textures.plaster if index == 0 else textures.bricks)
            furnish[index](build, walls[index])
        _add_pictures(build, walls[: 4 // len(quarters)], repeated=False, bare=frozenset())
        if repeats == "two_rooms":
            _add_partition(build, half)
        copies = [_turned(face, quarter) for quarter in quarters for face in build.surfaces]
    build.surfaces = shell + copies
    return _lit(build, half)


def _turned_alike(image: UINT8, times: int) -> UINT8:
    """Return an image that looks the same after a half turn, or after a quarter turn if `times` is 4."""
    out = image.copy()
    middle = image.shape[0] // 2
    if times == 2:
        out[image.shape[0] - middle :] = np.rot90(image[:middle], 2)
        return out
    quarter = image[:middle, : image.shape[1] - middle]
    side = min(quarter.shape[:2])
    quarter = quarter[:side, :side]
    upper = np.concatenate([quarter, np.rot90(quarter, 3)], axis=1)
    return np.asarray(np.concatenate([upper, np.rot90(upper, 2)]))


def _turned(face: Surface, quarters: int) -> Surface:
    """Return a copy of a rectangle, turned about the vertical in the room's middle by quarter turns."""
    turn = np.round(so3_exp(np.array([0.0, 0.0, quarters * np.pi / 2])))
    return replace(face, corner=turn @ face.corner, across=turn @ face.across, down=turn @ face.down)


def _shifted(face: Surface, shift_m: FloatArray) -> Surface:
    """Return a copy of a rectangle, shifted by a vector (3,) in metres."""
    return replace(face, corner=face.corner + shift_m)


def _face_of(wall: _Wall) -> Surface:
    """Return the rectangle of a whole wall without an image."""
    return surface_facing(
        wall.point_at(0.0, HEIGHT_M / 2, 0.0), wall.normal, (wall.length_m, HEIGHT_M), _BLANK
    )


def _add_partition(build: _Builder, half: list[float]) -> None:
    """Add half of a wall at x = 0 with two openings: the side of +x. A half turn gives the other half."""
    near, far = _OPENING_M
    thick = _PARTITION_M / 2
    paint = int(build.rng().integers(1 << 30))

    def one_paint(height: int, width: int, scale: float, _: np.random.Generator) -> UINT8:
        return textures.plaster(height, width, scale, np.random.default_rng(paint))

    for low, high, bottom, top in (
        (-far, far, _OPENING_TOP_M, HEIGHT_M),
        (-near, near, 0.0, _OPENING_TOP_M),
        (far, half[1], 0.0, HEIGHT_M),
        (-half[1], -far, 0.0, HEIGHT_M),
    ):
        centre = np.array([thick / 2, (low + high) / 2, (bottom + top) / 2])
        faces = box_faces(centre, (thick, high - low, top - bottom), 0.0)
        for face in (faces[0], faces[2], faces[3], faces[5]):
            build.surfaces.append(replace(face, image=build.image(face.size_m, one_paint)))


def _add_table(build: _Builder) -> None:
    """Add a high table with boxes, a screen and papers, for a person who stands at it."""
    rng = build.rng()
    centre = np.array([*_TABLE, 0.0])
    build.box(centre + np.array([0, 0, _TABLE_TOP_M - 0.02]), (1.5, 0.7, 0.04), 0.0, textures.planks)
    for side in (-1, 1):
        leg = centre + np.array([side * 0.66, 0, _TABLE_TOP_M / 2 - 0.02])
        build.box(leg, (0.05, 0.6, _TABLE_TOP_M - 0.04), 0.0, textures.metal)
    build.box(centre + np.array([-0.42, 0.22, _TABLE_TOP_M + 0.21]), (0.52, 0.04, 0.32), 8.0, pictures.screen)
    build.box(centre + np.array([-0.42, 0.22, _TABLE_TOP_M + 0.03]), (0.2, 0.14, 0.06), 8.0, textures.metal)
    for x, y in ((0.12, 0.22), (0.42, 0.1), (0.6, -0.15), (-0.6, -0.1)):
        size = rng.uniform(0.08, 0.2, 3)
        spot = centre + np.array([x, y, _TABLE_TOP_M + size[2] / 2])
        build.box(spot, size, float(rng.uniform(0, 90)), pictures.cardboard)
    for x in (-0.3, 0.15):
        place = centre + np.array([x, -0.15, _TABLE_TOP_M + 0.003])
        sheet = box_faces(place, (0.3, 0.21, 0.006), float(rng.uniform(-20, 20)))[4]
        image = build.image((0.3, 0.21), pictures.research_poster, _PICTURE_DETAIL)
        build.surfaces.append(replace(sheet, image=image))


def _add_flat_pictures(build: _Builder, half: list[float], walls: list[_Wall], options: SynthOptions) -> None:
    """Add flat pictures at random positions on the plain surfaces that were requested."""
    faces = dict(zip(("floor", "ceiling"), _floor_and_ceiling(half), strict=True))
    faces |= {name: _face_of(wall) for name, wall in zip(_WALL_NAMES, walls, strict=True)}
    for name in sorted(options.bare):
        rng = build.rng()
        for _ in range(options.flat_pictures):
            kind = pictures.WALL_PICTURES[int(rng.integers(len(pictures.WALL_PICTURES)))]
            build.surfaces.append(_picture_on(build, faces[name], kind, rng))


def _picture_on(build: _Builder, face: Surface, kind: Texture, rng: np.random.Generator) -> Surface:
    """Return a flat picture at a random position on a surface."""
    lengths = np.array(face.size_m)
    size = rng.uniform(*_FLAT_PICTURE_M, 2)
    place = 0.5 * lengths + rng.uniform(-0.5, 0.5, 2) * _FLAT_PICTURE_SPREAD * (lengths - size) - size / 2
    right, down = face.across / lengths[0], face.down / lengths[1]
    corner = face.corner + place[0] * right + place[1] * down + _FLAT_PICTURE_OFF_M * face.normal
    image = build.image((float(size[0]), float(size[1])), kind, _PICTURE_DETAIL)
    return Surface(corner=corner, across=size[0] * right, down=size[1] * down, image=image)


def _add_ceiling_fittings(build: _Builder, half: list[float]) -> None:
    """Add ducts, beams and cable trays below the ceiling."""
    rng = build.rng()
    for along, texture in ((-0.55, textures.metal), (0.1, textures.planks), (0.7, textures.fabric)):
        size = (2 * half[0] - 0.02, rng.uniform(0.14, 0.28), rng.uniform(0.10, 0.2))
        centre = np.array([0.0, along * half[1], HEIGHT_M - size[2] / 2])
        build.box(centre, size, 0.0, texture)
    size = (2 * half[1] - 0.02, 0.1, 0.07)
    build.box(np.array([0.35 * half[0], 0.0, HEIGHT_M - 0.25]), size, 90.0, textures.metal)
    for _ in range(6):
        spot = np.array([*(rng.uniform(-0.85, 0.85, 2) * half), HEIGHT_M - 0.03])
        size = (rng.uniform(0.15, 0.4), rng.uniform(0.12, 0.3), 0.06)
        build.box(spot, size, float(rng.uniform(0, 90)), pictures.cardboard)


def _add_lamp_housings(build: _Builder, lamps: FloatArray) -> None:
    """Add a bright panel at each lamp position (L,3)."""
    for lamp in lamps:
        tint = build.rng().uniform(0.94, 1.0, 3)
        face = box_faces(lamp + np.array([0, 0, 0.03]), (0.9, 0.3, 0.02), 0.0)[5]
        image = np.full((40, 120, 3), 255, np.uint8)
        image[3:-3, 3:-3] = (tint * 250).astype(np.uint8)
        build.surfaces.append(replace(face, image=image, shines=True))


_BLANK: UINT8 = np.zeros((1, 1, 3), np.uint8)
"""Placeholder image of a face whose texture has not been drawn yet."""
