"""The roofline's arithmetic: what must move is what the buffers hold, and a fraction is of the tighter bound."""

import numpy as np
import pytest

from gi_core.bench import SKY_PATCHES, daylight, talk_size_sector
from gi_core.bench_roofline import run, work
from gi_core.device import shared_device
from gi_core.relight import Relighter
from gi_core.resident_sector import ResidentSector
from gi_core.shadow_map import SunSamples

KERNELS = ["sample_shadow_map", "sun_on_surfels", "light_bricks", "bounce_bricks", "gather_probes", "relight_sector"]


def test_a_quick_run_has_both_peaks_and_every_kernel_of_a_tick() -> None:
    rows = {row.name.removeprefix("roofline_"): row for row in run(rounds=1)}
    assert list(rows) == ["stream_triad", "fma_loop", *KERNELS]
    memory, arithmetic = 1e9 * rows["stream_triad"].median, 1e9 * rows["fma_loop"].median
    for name in KERNELS:
        row = rows[name]
        by_memory, by_arithmetic = row.sizes["bytes"] / memory, row.sizes["flops"] / arithmetic
        assert row.baseline == pytest.approx(1e3 * max(by_memory, by_arithmetic))
        assert row.ratio == pytest.approx(row.baseline / row.median)
        assert row.baseline_is == f"its bound by {'memory' if by_memory >= by_arithmetic else 'arithmetic'}"


def test_what_must_move_is_what_the_buffers_hold() -> None:
    device = shared_device()
    resident = ResidentSector(device, talk_size_sector(0), SKY_PATCHES)
    given = daylight()
    Relighter(device).relight([resident], given)
    needs = work(resident, np.float32([0, 1, 0]))
    assert resident.bounces is not None
    assert resident.bounce_starts is not None
    bounced = [resident.bounces, resident.bounce_starts, resident.direct, resident.exitance, resident.cubes]
    # Starts have one entry more than there are bricks or probes, weights some padding behind them.
    assert needs["bounce_bricks"][0] == pytest.approx(sum(buffer.size for buffer in bounced), abs=128)
    gathered = [
        resident.factor_starts,
        resident.factor_source,
        resident.sky_starts,
        resident.factor_code,
        resident.factor_scale,
        resident.exitance,
        resident.cubes,
    ]
    assert needs["gather_probes"][0] == pytest.approx(sum(buffer.size for buffer in gathered), abs=128)
    samples = SunSamples(device, resident)
    sampled = samples.nbytes + samples.sun_sample.size + samples.sampled_in.size + resident.surfel_normal.size
    # On top the map's texels under one sector: 256 by 256 floats.
    assert needs["sample_shadow_map"][0] == pytest.approx(sampled + 4 * 256**2, abs=34 * 8)
