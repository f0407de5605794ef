"""The study of target errors, by known answers; what it measures on a city is in docs/TRADEOFF.md."""

from dataclasses import replace

import numpy as np

from bake_jobs.path_tracer import Estimate
from bake_jobs.target_study import blend


def test_blended_cubes_and_their_noise_follow_the_weights(make_sector):
    sector = make_sector(1)
    shape = sector.voxel_class.shape
    probe = np.zeros((*shape, 4), np.uint16)
    weight = np.zeros((*shape, 4), np.float32)
    probe[..., :2] = 0, 1
    weight[..., :2] = 0.25, 0.75
    weight[0, 0, 1] = 0, 1, 0, 0
    cubes = np.ones((sector.probe_count, 6, 3)) * np.arange(1, sector.probe_count + 1)[:, None, None]
    mean, noise = blend(
        replace(sector, voxel_probe=probe, voxel_weight=weight), np.array([[0, 0, 0], [1, 0, 0]]), Estimate(cubes, 0.1 * cubes)
    )
    np.testing.assert_allclose(mean[0], 0.25 * 1 + 0.75 * 2)
    np.testing.assert_allclose(mean[1], 2)
    # Probes' paths are their own: noise adds in squares, and is no larger than of one probe alone.
    np.testing.assert_allclose(noise[0], np.hypot(0.25 * 0.1, 0.75 * 0.2))
    np.testing.assert_allclose(noise[1], 0.2)
