"""Writes tests/golden/v<version>_sector<version>: datasets of two sectors, small enough to keep, that have every array of the format.

The versions are those of world.json and of sector files; folders without the latter have sector files of version 1.

    python tests/golden/make_golden.py

Run it only for a new format version. Files of a version that was released are never written again: they stand for what users have.
"""

import hashlib
from dataclasses import asdict, replace
from datetime import date
from pathlib import Path

import numpy as np

from bake_jobs.config import BakeSettings, settings_for
from bake_jobs.distant_transfer import TransferBaker
from bake_jobs.geometry_clip import SectorCutter
from bake_jobs.scene import Mesh, Scene, join_meshes
from bake_jobs.sector_job import SectorBaker
from bake_jobs.solids import boxes
from gi_core import distant_file, sector_file
from gi_core.constants import ROOM_CELL_M
from gi_core.container import write_atomic
from gi_core.dataset import DISTANT_FILE, VERSION, Dataset, SectorFacts, WorldInfo, fine_path, geometry_path, sector_path, write_world
from gi_core.distant_transfer import DistantTransfer
from gi_core.grid import SectorIndex
from gi_core.rooms import pack_cells
from gi_core.sun_table import SunTable
from gi_core.world import Decal, Lamp, Location, Opening, Room

BAKE_ID = "0123456789abcdef0123456789abcdef"
# Coarse enough for a few probes, and more than one feedback probe, so that their weights are stored.
SETTINGS = replace(
    settings_for("draft"),
    grid_spacing_m=16.0,
    wall_spacing_m=32.0,
    rays_per_face_edge=4,
    sun_declination_step_degrees=40.0,
    sun_hour_step_degrees=45.0,
    feedback_probes=2,
)
# Version 2 of world.json: harmonics, and a dome of patches.
SETTINGS_V2 = replace(SETTINGS, basis="sh2", sky="patches", sky_patches=8)
# Version 3: fine voxels. The ambient cube under six sky scalars may have them too.
SETTINGS_V3 = replace(SETTINGS, voxel_levels=2)


def tiny_scene() -> Scene:
    """Ground under two sectors, one of them with a negative index; a box; and another that shines."""
    ground = Mesh.of_colour(
        np.array([[-64.0, 0, 0], [-64, 0, 64], [64, 0, 64], [64, 0, 0]]), np.array([[0, 1, 2], [0, 2, 3]]), (0.3, 0.3, 0.3)
    )
    box = Mesh.of_colour(*boxes(np.array([20.0, 0, 22]), np.array([30.0, 9, 35])), (0.6, 0.5, 0.4))
    sign = Mesh.of_colour(*boxes(np.array([-30.0, 0, 25]), np.array([-24.0, 6, 40])), (0.5, 0.5, 0.5))
    sign = replace(sign, emission=np.full_like(sign.emission, 250.0))
    mesh = join_meshes([ground, box, sign])
    return Scene(
        mesh.vertices,
        mesh.triangles.astype(np.int32),
        mesh.albedo,
        mesh.emission,
        name="golden",
        location=Location(52.52, 13.405, 34.0, "Europe/Berlin", 10.0, date(2024, 3, 20), "given"),
        rooms=(Room("hall", (40.0, 0.0, 40.0), (50.0, 4.0, 50.0)),),
        lamps=(
            Lamp("lamp", "point", (10.0, 5.0, 10.0), 8000.0, (1.0, 0.8, 0.6), 25.0),
            Lamp("shop", "area", (20.0, 2.0, 28.0), 3000.0, direction=(-1.0, 0.0, 0.0), size=(3.0, 1.5), schedule="07:30-21:00"),
            Lamp("stage", "spot", (0.0, 6.0, 30.0), 5000.0, direction=(1.0, -1.0, 0.0), cone_degrees=40.0, schedule="night"),
        ),
    )


def scene_v4() -> Scene:
    """The same with a decal: version 4, whatever the settings."""
    return replace(tiny_scene(), decals=(Decal("taxi", (10.0, 0.25, 12.0), (1.8, 1.25, 4.6), 30.0),))


def scene_v5() -> Scene:
    """The same with rooms that have openings, one of them found: an L of cells. Version 5, whatever the settings and decals."""
    scene = scene_v4()
    air = np.ones((8, 16, 24), bool)
    air[:, 8:, 12:] = False
    door = Opening((43.0, 0.0, 40.0), (44.0, 2.0, 40.0))
    window = Opening((-50.0, 1.0, 26.0), (-50.0, 2.0, 28.0))
    found = Room(
        "found-1", (-50.0, 0.0, 25.0), (-40.625, 3.125, 31.25), (window,), pack_cells(np.argwhere(air)[:, [2, 0, 1]] + [-128, 0, 64])
    )
    return replace(scene, rooms=(replace(scene.rooms[0], openings=(door,)), found))


def scene_v6() -> Scene:
    """The same with a door between two rooms, one of them drawn as a mesh and so in finer cells. Version 6."""
    scene = scene_v5()
    cell_m = ROOM_CELL_M / 4
    air = np.ones((32, 32, 64), bool)
    air[:, 16:, 32:] = False
    door = Opening((50.0, 0.0, 43.0), (50.25, 2.0, 44.0), 2)
    at = np.argwhere(air)[:, [2, 0, 1]] + [514, 0, 416]
    vault = Room("vault", (50.25, 0.0, 40.625), (56.4, 3.1, 43.7), (replace(door, to=1),), pack_cells(at, cell_m))
    return replace(scene, rooms=(replace(scene.rooms[0], openings=(*scene.rooms[0].openings, door)), vault))


def write_golden(folder: Path, settings: BakeSettings = SETTINGS, scene: Scene | None = None) -> WorldInfo:
    """A whole dataset into a folder; of the tiny scene when no other is given."""
    scene = scene or tiny_scene()
    table = SunTable.build(scene.location, settings.sun_declination_step_degrees, settings.sun_hour_step_degrees)
    baker = SectorBaker(scene, settings, table.directions, BAKE_ID)
    sectors: dict[SectorIndex, SectorFacts] = {}
    sky: dict[SectorIndex, list[float]] = {}
    transfers: dict[SectorIndex, DistantTransfer] = {}
    for index in SectorCutter(scene).sectors():
        baked = baker.bake(index)
        write_atomic(geometry_path(folder, index), baked.geometry_bytes)
        write_atomic(sector_path(folder, index), baked.sector_bytes)
        fine = baked.fine_bytes
        if fine is not None:
            write_atomic(fine_path(folder, index), fine)
        digest = hashlib.blake2b(baked.sector_bytes, digest_size=16).hexdigest()
        counted = {name: baked.meta[name] for name in SectorFacts.__dataclass_fields__ if name in baked.meta}
        counted |= {"geometry_bytes": len(baked.geometry_bytes), "fine_bytes": None if fine is None else len(fine)}
        sectors[index] = SectorFacts(bytes=len(baked.sector_bytes), digest=digest, **counted)
        sky[index], transfers[index] = baked.meta["distant_sky"], baked.transfer
    write_atomic(folder / DISTANT_FILE, distant_file.encode(distant_file.assemble(sky, transfers), BAKE_ID))
    world = WorldInfo(
        name=scene.name,
        source="tests/golden/make_golden.py",
        bake_id=BAKE_ID,
        location=scene.location,
        bounds=scene.bounds,
        preset=settings.preset,
        basis=settings.basis,
        sky=settings.sky,
        sky_patches=settings.sky_sources,
        settings=settings.to_json(),
        seed=0,
        sun_table=table,
        sectors=sectors,
        rooms=scene.rooms,
        lamps=scene.lamps,
        dropped_triangles=asdict(scene.dropped),
        decals=scene.decals,
    )
    write_world(folder, world)
    return world


def write_distant(target: Path) -> None:
    """Version 2 of the distant file, of the sectors of v4: a file that v4 may have in its own one's place."""
    golden = Path(__file__).parent / "v4"
    table = Dataset.open(golden).world.sun_table
    baker = TransferBaker(scene_v4(), table.directions, SETTINGS.sky_sources)
    found = {SectorIndex(x, 0): sector_file.read(sector_path(golden, SectorIndex(x, 0))) for x in (-1, 0)}
    texels = distant_file.assemble(
        {index: meta["distant_sky"] for index, (_, meta) in found.items()},
        {index: baker.transfer(sector) for index, (sector, _) in found.items()},
    )
    write_atomic(target, distant_file.encode(texels, BAKE_ID))


# Of the cube and of harmonics, whose sector files have other arrays.
WRITTEN = {
    f"v{VERSION}_sector{sector_file.VERSION}": (SETTINGS, scene_v6()),
    f"v2_sector{sector_file.VERSION}": (SETTINGS_V2, tiny_scene()),
}

if __name__ == "__main__":
    for name, (settings, scene) in WRITTEN.items():
        print(name, write_golden(Path(__file__).parent / name, settings, scene).counts)
