"""The engine's queries: the same bytes whatever ran before, light everywhere by day, and trouble only where the trouble is."""

import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gi_core import engine as engine_module
from gi_core import relight, sector_file
from gi_core.constants import VOXEL_NO_SECTOR, VOXEL_OUTDOORS, VOXEL_SOLID
from gi_core.dataset import Dataset, sector_path
from gi_core.engine import Engine
from gi_core.errors import CorruptFileError, OutsideWorldError, SectorMissingError
from gi_core.grid import SectorIndex
from gi_core.sector import PROBE_IN_MARGIN, starts
from gi_core.volume import Volume

GOLDEN = Path(__file__).parents[1] / "golden"
HERE, THERE = SectorIndex(0, 0), SectorIndex(-1, 0)  # the golden dataset's sectors: x of 0..64 m and of -64..0 m
STREET = np.array([5.0, 2.0, 30.0])  # its volume reads both
IN_A_WALL = np.array([25.0, 4.0, 28.0])  # inside the golden scene's box
NOON, EVENING = ("12:00", "clear"), ("17:30", "overcast")


@pytest.fixture(scope="module")
def engine() -> Engine:
    return Engine(Dataset.open(GOLDEN / "v1"))


@pytest.fixture
def city(tmp_path) -> Path:
    """A copy of the golden dataset, to be damaged."""
    copy = tmp_path / "city"
    shutil.copytree(GOLDEN / "v1", copy)
    return copy


@pytest.fixture(scope="module")
def plane(tmp_path_factory, build, write_golden) -> Engine:
    """Open ground under three by two sectors, nothing else."""
    folder = tmp_path_factory.mktemp("plane")
    write_golden(folder, scene=build().ground((-64, 0), (128, 128), albedo=0.3).scene())
    return Engine(Dataset.open(folder))


def test_a_volume_says_how_far_its_bounces_are_from_their_fixed_point(engine, monkeypatch):
    settled = [volume.residual for volume in every_kind(engine)]
    assert all(residual is not None and 0 <= residual <= relight.QUERY_RESIDUAL for residual in settled)
    monkeypatch.setattr(relight, "MAX_PASSES", 5)
    given_up = [volume.residual for volume in every_kind(Engine(engine.dataset))]
    assert all(residual is not None and residual > relight.QUERY_RESIDUAL for residual in given_up)


def every_kind(engine: Engine) -> list[Volume]:
    light, room = engine.lighting(*NOON), engine.dataset.world.rooms[0]
    inside = (np.array(room.minimum) + np.array(room.maximum)) / 2
    return [engine.volume(STREET, light), engine.volume(STREET, light, cascade=1), engine.interior(inside, light)]


def everything(engine: Engine, query: tuple[str, float, float, tuple[str, str]]) -> bytes:
    """The bytes of one query's whole answer."""
    kind, x, z, moment = query
    position, light = np.array([x, 2.0, z]), engine.lighting(*moment)
    if kind in ("volume", "coarse volume"):
        volume = engine.volume(position, light, cascade=0 if kind == "volume" else 2)
        return volume.values.tobytes() + volume.mask.tobytes() + repr((volume.sectors, volume.first_voxel.tolist())).encode()
    if kind == "probes":
        probes = engine.probes(position, 30.0, light)
        return probes.position.tobytes() + probes.cubes.tobytes() + probes.flags.tobytes() + repr(probes.sectors).encode()
    return engine.distant(light).values.tobytes()


QUERIES = [
    (kind, x, z, moment)
    for kind in ("volume", "coarse volume", "probes", "distant")
    for x, z in ((5.0, 30.0), (-40.0, 10.0), (60.0, 60.0))
    for moment in (NOON, EVENING)
]


def test_the_same_query_gives_the_same_bytes_whatever_was_asked_before(engine):
    other = Engine(engine.dataset)
    first = {query: everything(engine, query) for query in QUERIES}
    second = {query: everything(other, query) for query in reversed(QUERIES)}
    again = {query: everything(engine, query) for query in reversed(QUERIES)}
    assert first == second == again
    # Not the same bytes for everything, which would also be deterministic.
    assert len({first[query] for query in QUERIES if query[0] == "volume"}) == 6


def test_queries_from_many_threads_give_the_bytes_of_lone_ones(engine):
    expected = {query: everything(engine, query) for query in QUERIES}
    fresh, wrong = Engine(engine.dataset), []

    def ask(shift: int) -> None:
        for query in QUERIES[shift:] + QUERIES[:shift]:
            if everything(fresh, query) != expected[query]:
                wrong.append(query)

    threads = [threading.Thread(target=ask, args=(5 * i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert wrong == []


@pytest.mark.parametrize(("resident_bytes", "lit_sectors"), [(1, 1024), (1 << 29, 1), (1, 1)])
def test_what_had_to_be_forgotten_is_computed_again_the_same(engine, monkeypatch, resident_bytes, lit_sectors):
    expected = {query: everything(engine, query) for query in QUERIES}
    monkeypatch.setattr(engine_module, "RESIDENT_BYTES", resident_bytes)
    monkeypatch.setattr(engine_module, "LIT_SECTORS", lit_sectors)
    forgetful = Engine(engine.dataset)
    assert {query: everything(forgetful, query) for query in QUERIES} == expected
    assert len(forgetful._lit) <= lit_sectors
    assert len(forgetful._residents) == (1 if resident_bytes == 1 else 2)


def test_what_a_caller_does_to_an_answer_stays_with_the_caller(engine):
    light = engine.lighting(*NOON)
    volume = engine.volume(STREET, light)
    kept = volume.values.copy()
    volume.values[:] = -1
    np.testing.assert_array_equal(engine.volume(STREET, light).values, kept)
    with pytest.raises(ValueError, match="read-only"):
        engine.lit_sector(HERE, light)[0] = 1


@pytest.mark.parametrize(
    "position",
    [(1e4, 0, 0), (0, 0, -1e4), (0, 1e4, 0), (0, -1e4, 0), (float("nan"), 0, 0), (0, float("inf"), 0), (1e300, 0, 0), (-129.0, 0, 30)],
)
def test_outside_the_world_is_refused_with_its_bounds(engine, position):
    light = engine.lighting(*NOON)
    for ask in (lambda p: engine.volume(p, light), lambda p: engine.probes(p, 10.0, light)):
        with pytest.raises(
            OutsideWorldError, match=r"outside this world; expected .* within \(-64\.0, 0\.0, 0\.0\) and \(64\.0, 9\.0, 64\.0\)"
        ):
            ask(np.array(position, np.float64))


def test_a_sector_that_is_not_there_is_missing(engine):
    with pytest.raises(SectorMissingError, match="sector 9,9"):
        engine.lit_sector(SectorIndex(9, 9), engine.lighting(*NOON))


def test_a_damaged_sector_fails_only_queries_that_need_it_and_heals(city, engine):
    file = sector_path(city, THERE)
    whole = file.read_bytes()
    file.write_bytes(whole[:-1])
    damaged = Engine(Dataset.open(city))
    light = damaged.lighting(*NOON)
    far_east = np.array([70.0, 2.0, 30.0])  # its volume ends at 20 m
    expected = engine.volume(far_east, light).values
    for _ in range(2):
        with pytest.raises(CorruptFileError, match=r"-1_0\.gisec"):
            damaged.volume(STREET, light)
        np.testing.assert_array_equal(damaged.volume(far_east, light).values, expected)
        assert list(damaged.failed_sectors) == [THERE]
        assert "-1_0.gisec" in damaged.failed_sectors[THERE]
    with pytest.raises(CorruptFileError, match=r"-1_0\.gisec"):
        damaged.probes(STREET, 30.0, light)
    file.write_bytes(whole)
    np.testing.assert_array_equal(damaged.volume(STREET, light).values, engine.volume(STREET, light).values)
    assert damaged.failed_sectors == {}


def test_a_damaged_distant_file_fails_only_the_far_view(city):
    (city / "distant.gidist").write_bytes(b"")
    damaged = Engine(Dataset.open(city))
    light = damaged.lighting(*NOON)
    with pytest.raises(CorruptFileError, match=r"distant\.gidist"):
        damaged.distant(light)
    assert damaged.volume(STREET, light).values.max() > 0


# A corner of the dataset, beyond an edge of it, and the middle.
@pytest.mark.parametrize("position", [(64.0, 2.0, 64.0), (-90.0, 2.0, 30.0), (5.0, 2.0, 30.0)])
@pytest.mark.parametrize("moment", [NOON, EVENING])
def test_by_day_no_air_is_black_up_to_the_edge_of_the_world_and_beyond(engine, position, moment):
    volume = engine.volume(np.array(position), engine.lighting(*moment))
    centre_x = volume.origin[0] + 3.125 * np.arange(32)
    centre_z = volume.origin[2] + 3.125 * np.arange(32)
    beyond = (centre_z < 0)[:, None] | (centre_z > 64)[:, None] | (np.abs(centre_x) > 64)[None, :]
    assert beyond.any()
    np.testing.assert_array_equal(volume.mask == VOXEL_NO_SECTOR, np.broadcast_to(beyond, volume.mask.shape))
    air = volume.mask != VOXEL_SOLID
    assert np.isfinite(volume.values).all()
    assert volume.values.min() >= 0
    # Every voxel of air sees some sky above it or some lit surface around it.
    assert (volume.values.sum(axis=0)[air] > 0).all()


def test_a_sector_without_probes_takes_its_neighbours_light(city):
    """Its air is still air: black would be wrong, and show as a hole in the street."""
    whole = Dataset.open(city).sector(HERE)
    bare = replace(
        whole,
        probe_position=whole.probe_position[:0],
        probe_flags=whole.probe_flags[:0],
        probe_room=whole.probe_room[:0],
        factor_starts=starts(np.zeros(0, np.int64)),
        factor_source=whole.factor_source[:0],
        factor_code=whole.factor_code[:0],
        factor_scale=whole.factor_scale[:0],
        factor_trim=None if whole.factor_trim is None else whole.factor_trim[:0],
        feedback_weight=0 * whole.feedback_weight,
        voxel_probe=0 * whole.voxel_probe,
        voxel_weight=0 * whole.voxel_weight,
    )
    bake_id = Dataset.open(city).world.bake_id
    sector_path(city, HERE).write_bytes(sector_file.encode(bare, {"bake_id": bake_id}, 6))
    bare_engine = Engine(Dataset.open(city))
    light = bare_engine.lighting(*NOON)
    volume = bare_engine.volume(STREET, light)
    assert (volume.values[2][volume.mask == VOXEL_OUTDOORS] > 0).all()
    # The class of a voxel is what was baked, whoever lights it.
    assert VOXEL_SOLID in volume.mask
    # With no lit sector in reach there is nothing to take.
    alone = bare_engine.volume(np.array([70.0, 2.0, 30.0]), light)
    assert alone.sectors == (HERE,)
    assert not alone.values.any()


def test_a_camera_inside_a_wall_gets_the_light_around_it(engine):
    volume = engine.volume(IN_A_WALL, engine.lighting(*NOON))
    at = np.floor(IN_A_WALL / 3.125).astype(int) - volume.first_voxel
    assert volume.mask[at[1], at[2], at[0]] == VOXEL_SOLID
    assert (volume.values[2][volume.mask == VOXEL_OUTDOORS] > 0).all()
    assert 0 < volume.valid < 1


def test_every_probe_is_listed_once_by_the_sector_it_lies_in(engine):
    light = engine.lighting(*NOON)
    found = engine.probes(STREET, 1e6, light)
    assert len(np.unique(found.position, axis=0)) == len(found.position)
    assert (found.flags & PROBE_IN_MARGIN == 0).all()
    own = {index: engine.dataset.sector(index).probe_flags & PROBE_IN_MARGIN == 0 for index in (THERE, HERE)}
    assert any((~mine).any() for mine in own.values()), "the golden dataset has probes in a margin"
    assert list(found.sectors) == [THERE] * own[THERE].sum() + [HERE] * own[HERE].sum()
    for index in (THERE, HERE):
        here = np.array([sector == index for sector in found.sectors])
        np.testing.assert_array_equal(found.cubes[here], engine.lit_sector(index, light)[own[index]])
        low = index.origin
        # Positions are rounded to 1/512 m.
        assert (found.position[here][:, [0, 2]] >= low[[0, 2]] - 0.002).all()
        assert (found.position[here][:, [0, 2]] <= low[[0, 2]] + 64.002).all()


@pytest.mark.parametrize("radius", [0.0, 1.0, 12.0, 25.0])
def test_probes_are_those_within_the_radius(engine, radius):
    light = engine.lighting(*NOON)
    everyone = engine.probes(STREET, 1e6, light)
    expected = np.linalg.norm(everyone.position - STREET, axis=1) <= radius
    found = engine.probes(STREET, radius, light)
    np.testing.assert_array_equal(found.position, everyone.position[expected])
    np.testing.assert_array_equal(found.cubes, everyone.cubes[expected])


def test_open_ground_sees_the_whole_sky_from_far_away(plane):
    light = plane.lighting(*NOON)
    distant = plane.distant(light, "sky")
    assert distant.values.shape == (2, 3, 6, 3)
    assert distant.origin == (-1, 0)
    assert distant.valid.all()
    # The bake's rays stop 4 to a face's edge, and the horizon runs through the middle of the side faces: a few percent.
    for face in (0, 1, 2, 4, 5):
        np.testing.assert_allclose(distant.values[:, :, face], np.broadcast_to(light.sky_cube[face], (2, 3, 3)), rtol=0.03)
    # Nothing of the sky is below.
    assert not distant.values[:, :, 3].any()


def test_the_far_view_is_sky_factors_times_the_sky(engine):
    """Factors are shares of what each face can see: all of +Y, half of a side; so a whole side's 0.5 gives back the sky's cube."""
    light = engine.lighting(*EVENING)
    texels = engine.dataset.distant()
    share = np.array([0.5, 0.5, 1, 1, 0.5, 0.5])
    expected = texels.sky[..., None] * (light.sky_cube / share[:, None])
    # One rounding to float32 for the exitance and one for the product.
    np.testing.assert_allclose(engine.distant(light).values[:, :, [0, 1, 2, 4, 5]], expected[:, :, [0, 1, 2, 4, 5]], rtol=3e-7)


def test_open_ground_is_lit_alike_in_every_sector(plane):
    """No seam: where all sectors are the same, the volume across their borders is the same too."""
    light = plane.lighting(*NOON)
    volume = plane.volume(np.array([32.0, 2.0, 64.0]), light)
    assert len(volume.sectors) == 6
    up = volume.values[2, ..., 1][volume.mask == VOXEL_OUTDOORS]
    # Coarse rays see a little more or less of the horizon: 1 %.
    assert up.max() / up.min() < 1.01
    assert up.min() == pytest.approx(light.sky_cube[2][1], rel=0.02)
