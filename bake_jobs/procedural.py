"""``procedural:midtown``: a Manhattan of blocks, avenues and setback towers, from a seed. For demos, tests and scaling, at any size.

Streets run along the axes and a block with its half streets is 96 m by 64 m, so 2 x 2 blocks are 6 sectors and 64 x 64 are 6 144.
A block depends on the seed and its own place only: a larger city contains the smaller one.
"""

from collections.abc import Iterator
from itertools import pairwise
from urllib.parse import parse_qsl

import numpy as np

from bake_jobs.building import BELOW_GROUND_M, Building, Rectangle, Tier, build, room_of
from bake_jobs.scene import Mesh, SourceContent, join_meshes
from bake_jobs.solids import boxes
from gi_core.errors import SourceError
from gi_core.world import Lamp, Room

PREFIX = "procedural:"
MAX_BLOCKS = 64  # along each side
AVENUE_M, STREET_M = 20.0, 16.0
BLOCK_X_M, BLOCK_Z_M = 76.0, 48.0
PITCH_X_M, PITCH_Z_M = AVENUE_M + BLOCK_X_M, STREET_M + BLOCK_Z_M
SIDEWALK_M, KERB_M = 4.0, 0.15
GROUND_CELL_M = 32.0
# The ground ends this far inside the city's edge, where a sector begins: a vertex on that border would belong to an empty sector.
EDGE_M = 0.01
ASPHALT, PAVING = (0.12, 0.12, 0.12), (0.32, 0.31, 0.29)
FACADES = ((0.42, 0.30, 0.24), (0.52, 0.48, 0.41), (0.38, 0.38, 0.38), (0.50, 0.42, 0.32), (0.30, 0.33, 0.36), (0.46, 0.38, 0.33))
LOT_MIN_M, LOT_MAX_M = 13.0, 26.0
TOWER_SHARE, ENTERABLE_SHARE = 0.35, 0.4
REAR_YARD_M = (3.0, 6.0)  # between the two rows of a block
STREET_LAMP_LM, STREET_LAMP_HEIGHT_M = 8000.0, 8.0
ROOM_LAMP_LM = 3000.0
WARM = (1.30, 0.95, 0.60)  # about 3000 K, luminance 1


def load_procedural(source: str) -> SourceContent:
    """The city that ``procedural:midtown?blocks=8x8&seed=1`` names. Raises SourceError for an unknown name, key or value."""
    blocks_x, blocks_z, seed = _parse(source)
    meshes = [_ground(blocks_x, blocks_z)]
    rooms: list[Room] = []
    lamps: list[Lamp] = []
    for i in range(blocks_x):
        for j in range(blocks_z):
            block = Rectangle(
                i * PITCH_X_M + AVENUE_M / 2,
                j * PITCH_Z_M + STREET_M / 2,
                (i + 1) * PITCH_X_M - AVENUE_M / 2,
                (j + 1) * PITCH_Z_M - STREET_M / 2,
            )
            name = f"block {i},{j}"
            meshes.append(_sidewalk(block))
            lamps += _street_lamps(block, name)
            for building in _buildings(block, name, np.random.default_rng([seed, i, j])):
                meshes.append(build(building))
                room = room_of(building)
                if room is not None:
                    rooms.append(room)
                    lamps.append(_room_lamp(room))
    return SourceContent(join_meshes(meshes), None, tuple(rooms), tuple(lamps), name=f"midtown {blocks_x}x{blocks_z} seed {seed}")


def _parse(source: str) -> tuple[int, int, int]:
    name, _, query = source.removeprefix(PREFIX).partition("?")
    if name != "midtown":
        raise SourceError(f"{source}: expected procedural:midtown, found procedural:{name}")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=bool(query), max_num_fields=8)
    except ValueError as error:
        raise SourceError(f"{source}: expected key=value pairs such as blocks=8x8&seed=1 ({error})") from error
    values = {"blocks": "8x8", "seed": "1"}
    for key, value in pairs:
        if key not in values:
            raise SourceError(f"{source}: unknown key {key}; expected {' or '.join(values)}")
        values[key] = value
    sides = [int(side) if side.isascii() and side.isdigit() and len(side) < 4 else 0 for side in values["blocks"].split("x")]
    if len(sides) != 2 or not all(1 <= side <= MAX_BLOCKS for side in sides):
        raise SourceError(f"{source}: blocks: expected two counts from 1 to {MAX_BLOCKS} such as 8x8, found {values['blocks']!r}")
    seed = values["seed"]
    if not (seed.isascii() and seed.isdigit() and len(seed) < 10):
        raise SourceError(f"{source}: seed: expected a whole number from 0 to 999999999, found {seed!r}")
    return sides[0], sides[1], int(seed)


def _ground(blocks_x: int, blocks_z: int) -> Mesh:
    """The streets' surface at y = 0, in cells small enough for a ray caster's boxes."""
    nx, nz = (int(np.ceil(count * pitch / GROUND_CELL_M)) for count, pitch in ((blocks_x, PITCH_X_M), (blocks_z, PITCH_Z_M)))
    x = np.clip(np.arange(nx + 1) * GROUND_CELL_M, EDGE_M, blocks_x * PITCH_X_M - EDGE_M)
    z = np.clip(np.arange(nz + 1) * GROUND_CELL_M, EDGE_M, blocks_z * PITCH_Z_M - EDGE_M)
    gx, gz = np.meshgrid(x, z, indexing="ij")
    a = (np.arange(nx)[:, None] * (nz + 1) + np.arange(nz)[None, :]).ravel()
    triangles = np.concatenate([np.stack([a, a + 1, a + nz + 2], 1), np.stack([a, a + nz + 2, a + nz + 1], 1)])
    return Mesh.of_colour(np.stack([gx.ravel(), np.zeros(gx.size), gz.ravel()], axis=1), triangles.astype(np.int64), ASPHALT)


def _sidewalk(block: Rectangle) -> Mesh:
    return Mesh.of_colour(*boxes(np.array([block.x0, BELOW_GROUND_M, block.z0]), np.array([block.x1, KERB_M, block.z1])), PAVING)


def _buildings(block: Rectangle, name: str, random: np.random.Generator) -> Iterator[Building]:
    """Lots side by side along x; each is one tower from street to street, or two houses back to back."""
    land = block.inset(SIDEWALK_M)
    edges = _lot_edges(land.x0, land.x1, random)
    lots: list[tuple[Rectangle, tuple[str, ...], bool]] = []
    for number, (x0, x1) in enumerate(pairwise(edges)):
        avenues = ("x-",) * (number == 0) + ("x+",) * (number == len(edges) - 2)
        if random.random() < TOWER_SHARE:
            lots.append((Rectangle(x0, land.z0, x1, land.z1), ("z-", "z+", *avenues), True))
        else:
            depth = round((land.z1 - land.z0 - float(random.uniform(*REAR_YARD_M))) / 2, 2)
            lots.append((Rectangle(x0, land.z0, x1, land.z0 + depth), ("z-", *avenues), False))
            lots.append((Rectangle(x0, land.z1 - depth, x1, land.z1), ("z+", *avenues), False))
    enterable = random.random(len(lots)) < ENTERABLE_SHARE
    enterable[random.integers(len(lots))] = True  # every block has a room
    for number, (plan, streets, is_tower) in enumerate(lots):
        tiers = _tower(plan, random) if is_tower else _house(plan, random)
        facade = FACADES[random.integers(len(FACADES))]
        ceiling = round(float(random.uniform(3.6, 4.6)), 2) if enterable[number] else None
        yield Building(f"{name} lot {number}", tiers, streets, facade, ceiling)


def _lot_edges(begin: float, end: float, random: np.random.Generator) -> list[float]:
    edges = [begin]
    while end - edges[-1] > LOT_MAX_M:
        width = float(random.uniform(LOT_MIN_M, LOT_MAX_M))
        edges.append(round(min(edges[-1] + width, end - LOT_MIN_M), 2))
    return [*edges, end]


def _house(plan: Rectangle, random: np.random.Generator) -> tuple[Tier, ...]:
    storeys = int(random.integers(4, 8) if random.random() < 0.65 else random.integers(8, 16))
    top = 1.0 + 3.3 * storeys
    return (Tier(plan, BELOW_GROUND_M, top), _bulkhead(plan, top, random))


def _tower(plan: Rectangle, random: np.random.Generator) -> tuple[Tier, ...]:
    """A podium to the street and up to two setbacks: New York's zoning of 1916. Each tier stands OVERLAP deep in the one below."""
    tiers = [Tier(plan, BELOW_GROUND_M, float(random.uniform(14, 30)))]
    height = float(random.uniform(50, 150))
    for share in (float(random.uniform(0.5, 0.75)), 1.0):
        below = tiers[-1]
        inner = below.plan.inset(float(random.uniform(1.5, 3.0)))
        if height * share > below.top + 6.0 and min(inner.x1 - inner.x0, inner.z1 - inner.z0) > 7.0:
            tiers.append(Tier(inner, below.top - 0.5, height * share))
    return (*tiers, _bulkhead(tiers[-1].plan, tiers[-1].top, random))


def _bulkhead(roof: Rectangle, top: float, random: np.random.Generator) -> Tier:
    """The stair and lift head that every roof has."""
    width, depth = (0.3 * (roof.x1 - roof.x0), 0.3 * (roof.z1 - roof.z0))
    x = float(random.uniform(roof.x0 + 1.0, roof.x1 - width - 1.0))
    z = float(random.uniform(roof.z0 + 1.0, roof.z1 - depth - 1.0))
    return Tier(Rectangle(x, z, x + width, z + depth), top - 0.5, top + 3.0)


def _street_lamps(block: Rectangle, name: str) -> list[Lamp]:
    """Three on each long kerb, one in the middle of each short one, over the sidewalk's edge."""
    kerb = block.inset(0.6)
    third = (kerb.x1 - kerb.x0) / 3
    middle = (kerb.z0 + kerb.z1) / 2
    places = [(kerb.x0 + (k + 0.5) * third, z) for z in (kerb.z0, kerb.z1) for k in range(3)] + [(kerb.x0, middle), (kerb.x1, middle)]
    return [
        Lamp(f"{name} street lamp {number}", "point", (x, STREET_LAMP_HEIGHT_M, z), STREET_LAMP_LM, WARM, schedule="night")
        for number, (x, z) in enumerate(places)
    ]


def _room_lamp(room: Room) -> Lamp:
    """One below the middle of the ceiling."""
    (x0, _, z0), (x1, top, z1) = room.minimum, room.maximum
    return Lamp(f"{room.name} ceiling lamp", "point", ((x0 + x1) / 2, top - 0.4, (z0 + z1) / 2), ROOM_LAMP_LM, WARM)
