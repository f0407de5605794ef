"""``compare`` end to end on a dataset whose light can be written down: an open plain under a uniform sky, served by a stand-in engine
that is right, or wrong by a known factor."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from bake_jobs import compare
from bake_jobs.compare import CUBE_STAGES, FINE_STAGES, STAGES, choose_sectors, compare_dataset
from gi_core.basis import from_axes
from gi_core.constants import VOLUME_SHAPE, VOXEL_NO_SECTOR, VOXEL_OUTDOORS, VOXEL_SOLID
from gi_core.errors import InputError
from gi_core.geometry_file import Geometry
from gi_core.grid import SectorIndex, volume_first_voxel, voxel_centre
from gi_core.lighting import DirectionalLight, Lighting
from gi_core.volume import Volume
from gi_core.world import Lamp, Location

SKY, ALBEDO, GROUND_M = 1000.0, 0.3, 2.0
PLAIN = {SectorIndex(x, z): SimpleNamespace(probes=4) for x in range(-9, 9) for z in range(-9, 9)}


def plain_cube():
    """+X -X +Y -Y +Z -Z over an endless plain under a uniform sky."""
    side = np.pi / 2 * SKY * (1 + ALBEDO)
    faces = [side, side, np.pi * SKY, np.pi * ALBEDO * SKY, side, side]
    return np.repeat(np.array(faces, np.float32)[:, None], 3, axis=1)


class PlainDataset:
    """Sectors of bare ground, four probes each."""

    path = "plain"
    lamps = ()
    wall_height_m = 0.0  # of a black wall along z through the middle of every sector
    basis = "cube"
    has_fine_voxels = False
    rooms = ()

    def __init__(self, sectors=PLAIN):
        facts = {"basis": self.basis, "lamps": self.lamps, "rooms": self.rooms, "has_fine_voxels": self.has_fine_voxels}
        self.world = SimpleNamespace(preset="talk", location=Location(), sectors=sectors, bake_id="ab", **facts)

    def geometry(self, index):
        corners = index.origin + 64 * np.array([[0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 0, 0]]) + [0, GROUND_M, 0]
        wall = index.origin + [[32, GROUND_M + h, z] for h, z in ((0, 0), (0, 64), (self.wall_height_m, 64), (self.wall_height_m, 0))]
        triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)[: 4 if self.wall_height_m else 2]
        albedo = np.array([[ALBEDO] * 3] * 2 + [[0.0] * 3] * 2, np.float32)[: len(triangles)]
        return Geometry(np.concatenate([corners, wall]), triangles, albedo, np.zeros_like(albedo))

    def sector(self, index):
        position = np.array([[8, 4, 8], [50, 4, 8], [8, 9, 50], [50, 14, 50]], np.float32)
        return SimpleNamespace(index=index, probe_position=position, probe_room=np.zeros(4, np.uint16), probe_flags=np.zeros(4, np.uint8))


def plain_engine(factor=1.0, high_factor=1.0, no_sector_from=32, solid_from=32, basis="cube"):
    """Serves the plain's light in a basis, times a factor, that of voxels 5 m up or more times another one too. Voxel columns from an x
    index on are without a sector, or called solid."""

    class Engine:
        def __init__(self, dataset, device):
            pass

        def lighting(self, time, weather):
            sky = np.zeros((64, 128, 3), np.float32)
            sky[:32] = SKY
            dark = DirectionalLight(np.array([0.0, 1.0, 0.0]), np.zeros(3))
            return Lighting("2024-06-21T12:00:00", weather, dark, dark, sky, np.zeros((6, 3)), 0.0, 0.0, 0.0)

        def lit_sector(self, index, lighting):
            return factor * np.repeat((from_axes(basis) @ plain_cube())[None], 4, axis=0)

        def volume(self, position, lighting, basis=basis, cascade=0):
            first = volume_first_voxel(position, cascade)
            light = from_axes(basis) @ plain_cube()
            values = factor * np.broadcast_to(light[:, None, None, None], (len(light), *VOLUME_SHAPE, 3)).astype(np.float32)
            mask = np.full(VOLUME_SHAPE, VOXEL_OUTDOORS, np.uint8)
            heights = voxel_centre(first + np.arange(VOLUME_SHAPE[0])[:, None])[:, 1]
            values[:, heights > GROUND_M + 5] *= high_factor
            mask[heights < GROUND_M] = VOXEL_SOLID
            mask[:, :, solid_from:] = VOXEL_SOLID
            mask[:, :, no_sector_from:] = VOXEL_NO_SECTOR
            return Volume(values, mask, first, (), basis, cascade=cascade)

    return Engine


@pytest.fixture
def run(monkeypatch):
    def compare_plain(engine=None, states=("noon",), **options):
        monkeypatch.setattr(compare.Dataset, "open", lambda path: PlainDataset())
        monkeypatch.setattr(compare, "Engine", engine or plain_engine())
        options = {"sectors": [SectorIndex(0, 0)], "points_per_sector": 12, "samples": 1024} | options
        return compare_dataset("plain", states, **options)

    return compare_plain


# The plain ends 576 m out, where 1024 paths begin to see below the horizon: under 1 % of a side's light. Noise adds its share.
CLOSE = 0.015


def test_right_light_has_no_error_at_any_stage(run):
    report = run()
    for stage in STAGES:
        numbers = report["states"]["noon"][stage]
        assert numbers["n"] >= 12
        assert numbers["median"] < CLOSE, stage
        assert abs(numbers["bias"]) < CLOSE, stage
        assert numbers["noise"] < 0.01
    assert report["preset"] == "talk"
    assert report["basis"] == "cube"
    assert report["open_air_called_solid"] == 0


def test_harmonics_are_judged_as_harmonics_and_as_the_cube_that_is_made_of_them(run, monkeypatch):
    # Half a sphere of light has no band above the first: harmonics and the six faces hold it alike.
    monkeypatch.setattr(PlainDataset, "basis", "sh2")
    report = run(plain_engine(basis="sh2"))
    assert report["basis"] == "sh2"
    stages = report["states"]["noon"]
    assert tuple(stages) == STAGES + CUBE_STAGES
    for stage, numbers in stages.items():
        assert numbers["median"] < CLOSE, stage
        assert numbers["noise"] < 0.01, stage
    wrong = run(plain_engine(1.25, basis="sh2"), samples=256)["states"]["noon"]
    for stage, numbers in wrong.items():
        assert numbers["bias"] == pytest.approx(0 if stage.startswith("floor") else 0.25, abs=2 * CLOSE), stage


def test_fine_voxels_are_judged_at_the_same_points(run, monkeypatch):
    monkeypatch.setattr(PlainDataset, "has_fine_voxels", True)
    stages = run(plain_engine(1.25), samples=256)["states"]["noon"]
    assert tuple(stages) == STAGES + FINE_STAGES
    for figure in ("n", "median", "p95", "bias", "nrmse", "noise"):  # the plain's light is the same in voxels of any size
        assert stages["shaded_fine"][figure] == pytest.approx(stages["shaded"][figure], rel=1e-4)


def test_wrong_light_shows_everywhere_but_in_the_floor(run):
    stages = run(plain_engine(1.25))["states"]["noon"]
    for stage in STAGES[:-1]:
        assert stages[stage]["bias"] == pytest.approx(0.25, abs=CLOSE), stage
        assert stages[stage]["median"] == pytest.approx(0.25, abs=CLOSE), stage
    assert stages["floor"]["median"] < CLOSE


def test_black_light_is_wholly_wrong(run):
    stages = run(plain_engine(0.0))["states"]["noon"]
    assert all(stages[stage]["bias"] == -1 for stage in STAGES[:-1])


def test_no_light_by_day_is_told_of_and_little_light_or_none_by_night_is_not(run, monkeypatch):
    assert run(plain_engine(0.0), samples=64)["dark_by_day"] == []  # the stand-in's sky gives level ground no light
    monkeypatch.setattr(compare, "is_day", lambda lighting: True)
    assert run(plain_engine(0.0), samples=64)["dark_by_day"] == ["0,0 noon"]
    assert run(plain_engine(1e-6), samples=64)["dark_by_day"] == []


@pytest.mark.parametrize("factor", [np.nan, np.inf])
def test_light_that_is_no_number_is_told_of_at_any_hour(run, factor):
    report = run(plain_engine(factor), samples=64)
    assert report["dark_by_day"] == ["0,0 noon"]
    assert [report["states"]["noon"][stage]["median"] for stage in STAGES[:-1]] == [None] * 4
    assert report["states"]["noon"]["floor"]["median"] < 0.2
    json.dumps(report, allow_nan=False)


def test_voxels_are_read_at_their_own_height(run):
    stages = run(plain_engine(high_factor=1.5), samples=256)["states"]["noon"]
    assert stages["mid"]["bias"] == pytest.approx(0.5, abs=2 * CLOSE)
    assert abs(stages["near"]["bias"]) < 2 * CLOSE


def test_references_are_taken_where_the_voxels_are(run, monkeypatch):
    asked = []
    cubes = compare.Reference.cubes
    monkeypatch.setattr(compare.Reference, "cubes", lambda self, points: (asked.append(points), cubes(self, points))[1])
    run(samples=64, sectors=[SectorIndex(2, -3)])
    probes, near, mid, corners = asked
    assert len(probes) == 4
    for points in (probes, near, mid):
        assert ((points[:, [0, 2]] >= [128, -192]) & (points[:, [0, 2]] < [192, -128])).all()
    assert ((near[:, 1] > GROUND_M) & (near[:, 1] < GROUND_M + 3.2)).all()
    assert (mid[:, 1] > GROUND_M + 5.9).all()  # within 1 % of 6 m
    assert ((corners[:, 1] > GROUND_M) & (corners[:, 1] < GROUND_M + 3.125 + 0.79)).all()


def test_floor_follows_light_that_varies(run, monkeypatch):
    # A black wall dims one side of everything, along x alone: exact voxels put at the wrong place would be off by tens of percents.
    monkeypatch.setattr(PlainDataset, "wall_height_m", 40.0)
    stages = run(points_per_sector=60, samples=512)["states"]["noon"]
    assert stages["floor"]["median"] < 0.05
    assert stages["floor"]["nrmse"] < 0.18  # next to the wall trilinear sampling reads through it
    assert stages["shaded"]["nrmse"] > 0.3


@pytest.mark.parametrize(("schedule", "is_missed"), [("always", True), ("night", False)])
def test_lamps_shine_in_the_reference_while_they_are_on(run, monkeypatch, schedule, is_missed):
    lamp = Lamp("lamp", "point", (32.0, 12.0, 32.0), 1e9, range_m=500.0, schedule=schedule)
    monkeypatch.setattr(PlainDataset, "lamps", (lamp,))
    stages = run(samples=256)["states"]["noon"]
    for stage in ("probes", "near", "mid"):
        assert (stages[stage]["bias"] < -0.5) == is_missed, stage
    # An open plain's own bounce never comes back to it.
    assert abs(stages["shaded"]["bias"]) < 2 * CLOSE


def test_the_same_arguments_give_the_same_report(run):
    assert run(samples=64) == run(samples=64)
    assert run(samples=64) != run(samples=64, seed=1)


def test_voxels_without_a_sector_are_left_out_and_wrongly_solid_ones_are_counted(run):
    whole, half = run(samples=64), run(plain_engine(no_sector_from=16), samples=64)
    assert 0 < half["states"]["noon"]["near"]["n"] < whole["states"]["noon"]["near"]["n"]
    assert run(plain_engine(solid_from=16), samples=64)["open_air_called_solid"] == pytest.approx(0.5)


def test_progress_counts_every_sector_and_state(run):
    steps = []
    run(
        states=("noon", "overcast"),
        sectors=[SectorIndex(0, 0), SectorIndex(-1, 2)],
        samples=64,
        points_per_sector=2,
        progress=lambda done, total, what: steps.append((done, total, what)),
    )
    assert steps == [
        (1, 4, "sector 0,0 noon"),
        (2, 4, "sector 0,0 overcast"),
        (3, 4, "sector -1,2 noon"),
        (4, 4, "sector -1,2 overcast"),
    ]


def test_sectors_are_drawn_from_the_inside():
    picks = choose_sectors(PlainDataset(), seed=0)
    assert len(set(picks)) == 9
    assert all(-9 < i.x < 8 and -9 < i.z < 8 for i in picks)
    assert picks == choose_sectors(PlainDataset(), seed=0)
    assert picks != choose_sectors(PlainDataset(), seed=1)


def test_a_small_bake_compares_what_it_has():
    row = {SectorIndex(x, 0): SimpleNamespace(probes=1) for x in range(4)}
    assert choose_sectors(PlainDataset(row), seed=0) == sorted(row)


def test_no_probe_anywhere_is_refused():
    with pytest.raises(InputError, match="no sector has a probe"):
        choose_sectors(PlainDataset({SectorIndex(0, 0): SimpleNamespace(probes=0)}), seed=0)


@pytest.mark.parametrize(("options", "said"), [({"states": ["dawn"]}, "expected noon"), ({"points_per_sector": 0}, "at least 1 point")])
def test_bad_requests_are_refused(run, options, said):
    with pytest.raises(InputError, match=said):
        run(**options)
