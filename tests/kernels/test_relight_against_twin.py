"""Kernels equal their NumPy twins on random sectors, on every device found; the fixed point equals a float64 solve."""

from dataclasses import replace

import numpy as np
import pytest

from gi_core import layout, pocl_cpu, relight, relight_twin, resident_sector
from gi_core.basis import convert
from gi_core.constants import BASIS_SIZES
from gi_core.device import Device, available_devices, choose_device, describe
from gi_core.errors import DeviceError, InputError, KernelBuildError
from gi_core.factor_weights import FACE_STEPS, expanded
from gi_core.grid import SectorIndex
from gi_core.layout import DIRECTIONAL_LIGHT
from gi_core.relight import QUERY_RESIDUAL, Relighter
from gi_core.relight_input import RelightInput
from gi_core.resident_sector import VECTOR, ResidentSector
from gi_core.rooms import outdoor_blend
from gi_core.volume import box_record, plan_boxes
from kernels_cl import include_directory

PATCHES = 6
# Sums of at most 40 surfels and 30 factors in float32, in the twin's order or another; worst seen 6e-7 of the peak.
CLOSE = 4e-6


@pytest.fixture(scope="module", params=[(describe(d), phases) for d in available_devices() for phases in (False, True)], ids=str)
def device(request) -> Device:
    name, by_phases = request.param
    device = Device(name)
    if by_phases:
        device.is_processor = False
    return device


def given_light(seed: int, lights: int, planes: int = 12, snow: float = 0.0, patches: int = PATCHES) -> RelightInput:
    rng = np.random.default_rng(seed)
    records = np.zeros(lights, DIRECTIONAL_LIGHT.dtype)
    for record in records:
        direction = rng.normal(size=3)
        record["direction"][:3] = direction / np.linalg.norm(direction)
        record["irradiance"][:3] = rng.uniform(0, 1e5, 3)
        record["plane"] = rng.integers(0, planes, 4)
        weight = rng.uniform(0, 1, 4)
        record["plane_weight"] = weight / weight.sum()
    return RelightInput(rng.uniform(0, 2e4, (patches, 3)).astype(np.float32), records, snow)


SHAPES = [
    {},
    {"emits": True},
    {"feedback": 4},
    {"probes": 1},
    {"probes": 1000, "surfels": 3000},
    {"basis": 4},
    {"basis": 9},
    {"basis": 9, "feedback": 6, "patches": 32},
    {"basis": 9, "probes": 1000, "surfels": 3000},
    {"surfels": 1},
    {"surfels": 0},
    {"probes": 0},
]


@pytest.mark.parametrize("lights", [0, 1, 2])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_three_passes_equal_the_twins(device, make_sector, shape, lights):
    sector = make_sector(7, **shape)
    patches = shape.get("patches", PATCHES)
    given = given_light(lights, lights, patches=patches)
    resident = ResidentSector(device, sector, patches)
    start = np.random.default_rng(8).uniform(0, 1e4, (sector.probe_count, sector.basis_size, 3)).astype(np.float32)
    resident.write_cubes(start)
    Relighter(device).relight([resident], given, 3)
    expected = relight_twin.relight(sector, given, start, 3)
    peak = np.abs(expected).max(initial=1e-9)
    np.testing.assert_allclose(resident.read_cubes() / peak, expected / peak, atol=CLOSE)


@pytest.mark.parametrize("snow", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("lamps", [False, True])
def test_snow_and_lamps_equal_the_twins(device, make_sector, snow, lamps):
    sector, given = make_sector(14), given_light(14, 1, snow=snow)
    resident = ResidentSector(device, sector, PATCHES)
    light = np.zeros((sector.surfel_count, 4), np.float32)
    light[:, :3] = np.random.default_rng(14).uniform(0, 1e5, (sector.surfel_count, 3))
    if lamps:
        resident.set_lamps(device.upload(light))
    found = Relighter(device).converge(resident, given).cubes
    truth = relight_twin.solve(sector, given, lamps=light[:, :3] if lamps else None)
    assert np.abs(found - truth).max() <= 1e-4 * truth.max()


@pytest.mark.parametrize("lights", [1, 2])
def test_samples_of_the_shadow_map_stand_for_the_suns_baked_visibility(device, make_sector, lights):
    sector, given = make_sector(17), given_light(17, lights)
    resident = ResidentSector(device, sector, PATCHES)
    start = np.zeros((sector.probe_count, 6, 3), np.float32)
    sample = np.random.default_rng(17).integers(0, 256, sector.surfel_count).astype(np.uint8)
    sample[::3] = layout.NO_SAMPLE
    resident.set_sun_sample(device.upload(np.pad(sample, (0, -len(sample) % 8))))
    Relighter(device).relight([resident], given, 2)
    expected = relight_twin.relight(sector, given, start, 2, sun_sample=sample)
    peak = expected.max()
    np.testing.assert_allclose(resident.read_cubes() / peak, expected / peak, atol=CLOSE)
    baked = relight_twin.relight(sector, given, start, 2)
    assert np.abs(expected - baked).max() > 0.01 * peak


@pytest.mark.parametrize("basis", [4, 6, 9])
def test_one_launch_gives_the_bits_of_a_launch_for_each_phase(make_sector, basis):
    sector, given, found = make_sector(18, basis=basis, emits=True), given_light(18, 2, snow=0.4), []
    for by_phases in (False, True):
        device = Device()
        device.is_processor = not by_phases
        resident = ResidentSector(device, sector, PATCHES)
        Relighter(device).relight([resident], given, 5)
        found.append(resident.read_cubes())
        assert ("relight_sector" in dict(device.built_kernels)) != by_phases
    np.testing.assert_array_equal(*found)


def test_snow_comes_and_goes_without_a_trace(device, make_sector):
    resident = ResidentSector(device, make_sector(15), PATCHES)
    before = Relighter(device).converge(resident, given_light(15, 1)).cubes.tobytes()
    for snow in (0.2, 1.0):
        assert Relighter(device).converge(resident, given_light(15, 1, snow=snow)).cubes.tobytes() != before
    assert Relighter(device).converge(resident, given_light(15, 1)).cubes.tobytes() == before


def test_lamps_come_and_go_without_a_trace(device, make_sector):
    resident, given = ResidentSector(device, make_sector(16), PATCHES), given_light(16, 1)
    before = Relighter(device).converge(resident, given).cubes.tobytes()
    resident.set_lamps(device.upload(np.full((resident.sector.surfel_count, 4), 500, np.float32)))
    assert Relighter(device).converge(resident, given).cubes.tobytes() != before
    resident.set_lamps(None)
    assert Relighter(device).converge(resident, given).cubes.tobytes() == before


def test_sectors_in_one_call_equal_each_alone(device, make_sector):
    given = given_light(3, 1)
    together = [ResidentSector(device, make_sector(seed), PATCHES) for seed in (1, 2, 3)]
    passes = (4, 1, 3)
    Relighter(device).relight(together, given, passes)
    for resident, count in zip(together, passes, strict=True):
        alone = ResidentSector(device, resident.sector, PATCHES)
        Relighter(device).relight([alone], given, count)
        np.testing.assert_array_equal(resident.read_cubes(), alone.read_cubes())


@pytest.mark.parametrize("seed", range(8))
def test_convergence_reaches_the_float64_solve(device, make_sector, seed):
    # Random harmonics are no light and may grow: weak ones are what a real sector has.
    sector = make_sector(seed, emits=seed % 2 == 1, basis=6 if seed < 6 else 9, feedback=1 if seed < 6 else 3)
    if seed >= 6:
        sector = replace(sector, factor_scale=sector.factor_scale * np.float16(0.3))
    given = given_light(seed, seed % 3)
    found = Relighter(device).converge(ResidentSector(device, sector, PATCHES), given)
    truth = relight_twin.solve(sector, given)
    # The contract: within 1e-4 of the peak. The residual asked for is 1e-5.
    assert np.abs(found.cubes - truth).max() <= 1e-4 * np.abs(truth).max()
    assert found.residual <= 1e-5


def test_bounces_that_are_given_up_say_so_once_for_a_sector(device, make_sector, monkeypatch, caplog):
    monkeypatch.setattr(relight, "MAX_PASSES", 5)
    white = [replace(make_sector(seed, emits=True), index=SectorIndex(seed, -1)) for seed in (9, 10)]
    white = [replace(sector, surfel_albedo=np.full_like(sector.surfel_albedo, 0.95)) for sector in white]
    relighter, given = Relighter(device), given_light(9, 1)
    for sector in (*white, *white):
        found = relighter.converge(ResidentSector(device, sector, PATCHES), given)
        left = np.abs(found.cubes - relight_twin.solve(sector, given)).max() / np.abs(found.cubes).max()
        assert found.passes == 5
        assert QUERY_RESIDUAL < left <= found.residual
        assert any(f"{found.residual:.1e} of the brightest" in message for message in caplog.messages)
    assert [message[:42] for message in caplog.messages] == [f"sector {x},-1: bounces given up after 5 passes"[:42] for x in (9, 10)]


def test_feedback_is_a_contraction_at_the_highest_albedo(device, make_sector):
    sector = make_sector(9)
    # Every probe sees nothing but surfels, and every surfel reflects all that it may.
    white = replace(sector, surfel_albedo=np.full_like(sector.surfel_albedo, 0.95))
    resident = ResidentSector(device, white, PATCHES)
    resident.write_cubes(np.full((white.probe_count, 6, 3), 1e6, np.float32))
    dark = RelightInput(np.zeros((PATCHES, 3), np.float32), np.zeros(0, DIRECTIONAL_LIGHT.dtype))
    peaks = []
    for _ in range(20):
        Relighter(device).relight([resident], dark, 1)
        peaks.append(resident.read_cubes().max())
    # Form factors sum to one within float32: a pass keeps at most 95 % of the light.
    assert all(after <= before * 0.9501 for before, after in zip([1e6, *peaks], peaks, strict=False))


def test_the_same_input_gives_the_same_bytes(device, make_sector):
    sector, given = make_sector(10), given_light(10, 2)
    runs = [Relighter(device).converge(ResidentSector(device, sector, PATCHES), given).cubes.tobytes() for _ in range(3)]
    assert runs[0] == runs[1] == runs[2]


def test_cubes_that_never_change_are_written_once_until_something_is_relit(device, make_sector, monkeypatch):
    resident = ResidentSector(device, make_sector(0), PATCHES)
    light = np.ones((resident.sector.probe_count, 6, 3), np.float32)
    copied = []
    copy = resident_sector.cl.enqueue_copy
    monkeypatch.setattr(resident_sector.cl, "enqueue_copy", lambda *given, **more: copied.append(given[1]) or copy(*given, **more))

    def writes(cubes) -> int:
        before = sum(target is resident.cubes for target in copied)
        resident.write_cubes(cubes)
        return sum(target is resident.cubes for target in copied) - before

    assert (writes(light), writes(light)) == (1, 1), "an array that may change is read each time"
    light.setflags(write=False)
    assert (writes(light), writes(light)) == (1, 0)
    Relighter(device).relight([resident], given_light(0, 1))
    assert writes(light) == 1
    np.testing.assert_array_equal(resident.read_cubes(), light)
    assert (writes(2 * light), writes(light)) == (1, 1)


def test_no_light_is_exactly_dark(device, make_sector):
    dark = RelightInput(np.zeros((PATCHES, 3), np.float32), np.zeros(0, DIRECTIONAL_LIGHT.dtype))
    assert not Relighter(device).converge(ResidentSector(device, make_sector(11), PATCHES), dark).cubes.any()


@pytest.mark.parametrize(("source", "target"), [("sh2", "cube"), ("sh1", "cube"), ("sh2", "sh1"), ("cube", "cube"), ("sh2", "sh2")])
def test_a_served_basis_equals_the_twins(device, make_sector, source, target):
    sector = make_sector(18, basis=BASIS_SIZES[source])
    resident = ResidentSector(device, sector, PATCHES)
    light = np.random.default_rng(18).uniform(-1e4, 1e4, (sector.probe_count, sector.basis_size, 3)).astype(np.float32)
    light[:, 0] = np.abs(light[:, 0])  # there is no less light than none on the whole
    resident.write_cubes(light)
    found = np.zeros((sector.probe_count, BASIS_SIZES[target], 4), np.float32)
    device.read(resident.converted(target), found)
    expected = convert(light, source, target)
    np.testing.assert_allclose(found[..., :3], expected, atol=1e-6 * np.abs(expected).max())  # sums of nine in float32
    if target == "cube" != source:
        assert found.min() == 0


def test_a_richer_basis_is_not_served(device, make_sector):
    with pytest.raises(InputError, match="this light is in cube"):
        ResidentSector(device, make_sector(18), PATCHES).converted("sh2")


@pytest.mark.parametrize("basis", [4, 6, 9])
def test_a_volume_equals_the_twins_blend(device, make_sector, basis):
    sector = make_sector(12, basis=basis)
    resident = ResidentSector(device, sector, PATCHES)
    cubes = np.random.default_rng(12).uniform(0, 1e4, (sector.probe_count, basis, 3)).astype(np.float32)
    resident.write_cubes(cubes)
    box = next(b for b in plan_boxes(np.array([0, -1, 0])) if b.index == sector.index)
    target = device.allocate(basis * 16 * 32 * 32 * 3 * 4)
    resident.fill_volume(box_record(box, sector), box.size, target)
    values = np.zeros((basis, 16, 32, 32, 3), np.float32)
    device.read(target, values)
    probe, weight = outdoor_blend(sector)
    expected = relight_twin.blend_voxels(replace(sector, voxel_probe=probe, voxel_weight=weight), cubes)
    (nx, ny, nz) = box.size
    np.testing.assert_allclose(values[:, :4, :nz, :nx], np.moveaxis(expected[:, :nz, :nx], 3, 0), rtol=2e-5)
    # Above its layers a sector repeats the highest.
    np.testing.assert_array_equal(values[:, ny - 1, :nz, :nx], values[:, 3, :nz, :nx])


def test_the_generated_header_is_in_step():
    assert (include_directory() / "layout.h").read_text() == layout.header_text()


def test_records_are_whole_vectors():
    for record in layout.RECORDS:
        assert record.dtype.itemsize % 16 == 0, record.name


def test_an_unknown_device_is_refused_with_the_list():
    with pytest.raises(DeviceError) as caught:
        choose_device("abacus")
    assert "abacus" in str(caught.value)
    assert describe(available_devices()[0]) in str(caught.value)


def test_a_kernel_that_does_not_build_shows_the_compilers_words(device):
    with pytest.raises(KernelBuildError, match=r"broken\.cl(.|\n)*nonsense"):
        device.build("__kernel void k() { nonsense; }", "broken.cl")


def test_a_missing_define_stops_the_build(device):
    with pytest.raises(KernelBuildError, match="FEEDBACK_PROBES"):
        device.kernel("collect_bounces", BASIS_SIZE=6, BOUNCE_ALBEDO_PERMILLE=950, HAS_FEEDBACK_WEIGHTS=0, HAS_SNOW=0)


@pytest.mark.parametrize(
    ("flags", "name"),
    [
        ({"avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "fsgsbase"}, b"haswell"),
        (pocl_cpu._TARGETS[0][1] | pocl_cpu._TARGETS[1][1], b"znver3"),
        ({"sse2"}, b"x86-64"),
    ],
)
def test_a_processor_too_new_for_the_compiler_gets_a_compatible_name(flags, name):
    assert pocl_cpu.compatible_cpu(flags) == name
    assert len(name) < len(pocl_cpu._UNKNOWN)


def test_only_the_build_error_of_an_unknown_processor_counts():
    assert pocl_cpu.is_unknown_cpu("error: unknown target CPU 'generic'\nDevice x failed")
    assert not pocl_cpu.is_unknown_cpu("error: use of undeclared identifier 'nonsense'")


@pytest.mark.parametrize("basis", [4, 9])
def test_every_factor_has_its_twins_codes_on_the_device(device, make_sector, basis):
    """All 49 ** 3 directions, and all first codes 42 times and more; the twin rounds in floats, and they never differ."""
    steps = np.arange(-FACE_STEPS, FACE_STEPS + 1)
    direction = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=3).reshape(-1, 3)
    first = np.random.default_rng(basis).integers(0, 128, len(direction))
    code = np.concatenate([first[:, None], direction], axis=1).astype(np.int8)
    sector = replace(make_sector(1, basis=basis), factor_code=code, factor_source=np.zeros(len(code), np.uint32))
    resident = ResidentSector(device, sector, PATCHES)
    found = np.zeros(resident.factor_code.size, np.uint8)
    device.read(resident.factor_code, found)
    expected = expanded(code, basis).astype(np.int16) + 128
    np.testing.assert_array_equal(found[: expected.size], expected.reshape(-1))
    # What the last factor's vector reaches into.
    np.testing.assert_array_equal(found[expected.size :], np.zeros(VECTOR))


@pytest.mark.parametrize("basis", [4, 9])
def test_bricks_weigh_bounces_as_their_twin_does(device, make_sector, basis):
    sector = make_sector(2, basis=basis)
    resident = ResidentSector(device, sector, PATCHES)
    found = np.zeros((sector.brick_count, basis), np.float32)
    device.read(resident.brick_basis, found)
    # Means of weights up to 1.1, summed in another order; worst seen 2.4e-7 in a city.
    np.testing.assert_allclose(found, relight_twin.brick_basis(sector), rtol=0, atol=6e-7)
