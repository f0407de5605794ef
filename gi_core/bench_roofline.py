"""How near each kernel of a tick comes to what the device can do: bytes and flops that it cannot do without, beside STREAM and an FMA loop.

    bytes    every array that the kernel needs, once: what a cache of any cleverness still has to be given
    flops    additions, multiplications and comparisons of floats; a fused pair counts as two, conversions and addresses as none
    bound    the longer of bytes / STREAM's rate and flops / the FMA loop's rate

Times are the device's own, from a kernel's start to its end, in ticks of ``relight_two_sectors_resampled``, with a launch for each kernel;
``relight_sector`` is what a processor runs instead of the last four, on one core, where the peaks are of all. STREAM (McCalpin, "Memory
bandwidth and machine balance", 1995) runs over as many bytes as the eight sectors of the rotation hold, so it reads from the same cache
or memory.
"""

from collections.abc import Callable

import numpy as np
import pyopencl as cl

from gi_core.bench import SKY_PATCHES, Measurement, side_by_side
from gi_core.bench_relight import ROTATION, Ticks, snowy_sectors
from gi_core.device import Device
from gi_core.layout import PLANES_PER_LIGHT, SHADOW_TAPS
from gi_core.resident_sector import ResidentSector
from gi_core.shadow_map_twin import LEAST_COSINE
from gi_core.shadow_plan import TEXELS_PER_METRE

# Independent chains of FMAs on vectors of eight: more than a core has in flight.
_CHAINS, _FMA_STEPS, _FMA_ITEMS = 10, 2000, 512
RELIGHT_KERNELS = ("sun_on_surfels", "light_bricks", "bounce_bricks", "gather_probes")
_SECTOR_TEXELS = int(64 * TEXELS_PER_METRE) ** 2

_PEAKS = f"""
__kernel void triad(__global const float8 *b, __global const float8 *c, const float scale, __global float8 *a)
{{
    const size_t i = get_global_id(0);
    a[i] = b[i] + scale * c[i];
}}
__kernel void fma_loop(const float by, const float add, __global float8 *out)
{{
    float8 {", ".join(f"x{i} = (float8)((float)get_global_id(0) + {i})" for i in range(_CHAINS))};
    for (int step = 0; step < {_FMA_STEPS}; ++step) {{
        {" ".join(f"x{i} = x{i} * by + add;" for i in range(_CHAINS))}
    }}
    out[get_global_id(0)] = {" + ".join(f"x{i}" for i in range(_CHAINS))};
}}
"""


def work(resident: ResidentSector, to_sun: np.ndarray[tuple[int, ...], np.dtype[np.float32]]) -> dict[str, tuple[int, int]]:
    """(bytes, flops) of each kernel of a worst tick for one sector: one light, snow, lamps, a shadow map, one weightless feedback probe."""
    sector = resident.sector
    surfels, bricks, probes, basis = sector.surfel_count, sector.brick_count, sector.probe_count, sector.basis_size
    facing = int((sector.surfel_normal @ to_sun > LEAST_COSINE).sum())
    bounces = 0 if resident.bounces is None else resident.bounces.size // 16
    cubes = 16 * probes * basis
    return {
        # Normal; place; sample and map number, read and written; the texels under the sector. Cosine; then for what faces the sun its
        # place in the map (36), the cell's slant (30), and for each tap its place (9), its depth (4) and two comparisons with a step.
        "sample_shadow_map": (surfels * (12 + 16 + 2 + 4) + 4 * _SECTOR_TEXELS, 6 * surfels + facing * (66 + 17 * SHADOW_TAPS)),
        # Normal, four bits, sample, share. Cosine, blend, product.
        "sun_on_surfels": (surfels * (12 + 1 + 4) + surfels * PLANES_PER_LIGHT // 8, surfels * (5 + PLANES_PER_LIGHT + 2)),
        # Albedo and snow, share; starts, what lamps gave, and the result. Snow (10), sun (6); colour, mean and sum.
        "light_bricks": (surfels * (16 + 4) + bricks * (4 + 16 + 16), surfels * 16 + bricks * 9),
        "bounce_bricks": (16 * bounces + bricks * (4 + 16 + 16) + 2 * 16 * SKY_PATCHES + cubes, 6 * bounces),
        "gather_probes": (
            sector.factor_count * (4 + basis) + 16 * (bricks + SKY_PATCHES) + probes * (8 + 8 * basis) + cubes,
            sector.factor_count * 7 * basis,
        ),
    }


def bench_roofline(device: Device, rounds: int = 40) -> list[Measurement]:
    """One row for STREAM, one for the FMA loop, one for each kernel: its time on one sector beside its bound, whose ratio is the
    fraction reached. ``device`` is a timed one of its own."""
    ticks = Ticks(device, snowy_sectors())
    held = sum(part.nbytes for parts in (ticks.residents, ticks.samples, ticks.surfel_lights) for part in parts)
    triad, bytes_a_second = _peak_bytes(device, held, rounds)
    fma, flops_a_second = _peak_flops(device, rounds)
    assert device.launched is not None
    seconds: dict[str, list[float]] = {}
    for is_processor in {device.is_processor, False}:
        device.is_processor = is_processor
        ticks = Ticks(device, snowy_sectors())
        for _ in range(ROTATION):
            ticks.everything()
        device.launched.clear()
        for _ in range(ROTATION * rounds):
            ticks.everything()
        for name, event in device.launched:
            seconds.setdefault(name, []).append(_seconds(event))
        device.launched.clear()
    rows = [triad, fma]
    needed = work(ticks.residents[0], ticks.given[0].lights["direction"][0, :3])
    if "relight_sector" in seconds:
        inner = [needed[name] for name in RELIGHT_KERNELS]
        needed["relight_sector"] = sum(n for n, _ in inner), sum(f for _, f in inner)
    for name, (nbytes, flops) in needed.items():
        taken = float(np.median(seconds[name]))
        by_memory, by_arithmetic = nbytes / bytes_a_second, flops / flops_a_second
        bound = max(by_memory, by_arithmetic)
        sizes = {"bytes": nbytes, "flops": flops, "MB/s": round(1e-6 * nbytes / taken), "MFLOP/s": round(1e-6 * flops / taken)}
        what = f"its bound by {'memory' if by_memory >= by_arithmetic else 'arithmetic'}"
        rows.append(Measurement(f"roofline_{name}", 1e3 * taken, "ms", 1e3 * bound, bound / taken, sizes, device.name, what))
    return rows


def _peak_bytes(device: Device, held: int, rounds: int) -> tuple[Measurement, float]:
    count = held // 3 // 32
    source = np.ones(8 * count, np.float32)
    b, c, a = device.upload(source), device.upload(source), device.allocate(32 * count)
    kernel = cl.Kernel(device.build(_PEAKS, "peaks"), "triad")
    kernel.set_scalar_arg_dtypes([None, None, np.float32, None])
    group = 64
    taken = _median(lambda: kernel(device.queue, (count // group * group,), (group,), b, c, 3.0, a), rounds)
    moved = 3 * 32 * (count // group * group)
    copy = source.copy()
    _, alone = side_by_side(lambda: None, lambda: np.copyto(copy, source), rounds)
    rate, baseline = moved / taken, 2 * source.nbytes / alone
    row = Measurement(
        "roofline_stream_triad", 1e-9 * rate, "GB/s", 1e-9 * baseline, rate / baseline, {"bytes": moved}, device.name, "memcpy, one core"
    )
    return row, rate


def _peak_flops(device: Device, rounds: int) -> tuple[Measurement, float]:
    out = device.allocate(32 * _FMA_ITEMS)
    kernel = cl.Kernel(device.build(_PEAKS, "peaks"), "fma_loop")
    kernel.set_scalar_arg_dtypes([np.float32, np.float32, None])
    taken = _median(lambda: kernel(device.queue, (_FMA_ITEMS,), (8,), 0.5, 1.0, out), rounds)
    flops = 2 * 8 * _CHAINS * _FMA_STEPS * _FMA_ITEMS
    matrix = np.ones((512, 512), np.float32)
    _, alone = side_by_side(lambda: None, lambda: matrix @ matrix, rounds)
    rate, baseline = flops / taken, 2 * 512**3 / alone
    row = Measurement(
        "roofline_fma_loop",
        1e-9 * rate,
        "GFLOP/s",
        1e-9 * baseline,
        rate / baseline,
        {"flops": flops},
        device.name,
        "BLAS, 512 x 512 floats",
    )
    return row, rate


def _median(launch: Callable[[], cl.Event], rounds: int) -> float:
    """Median device time [s] of a launch; the first, which may compile, is not counted."""
    taken = []
    for _ in range(rounds + 1):
        event = launch()
        event.wait()
        taken.append(_seconds(event))
    return float(np.median(taken[1:]))


def _seconds(event: cl.Event) -> float:
    return 1e-9 * (event.profile.end - event.profile.start)


def run(device_name: str | None = None, rounds: int = 40) -> list[Measurement]:
    """The rows on a device of its own, whose queue keeps times. Raises DeviceError."""
    return bench_roofline(Device(device_name, timed=True), rounds)
