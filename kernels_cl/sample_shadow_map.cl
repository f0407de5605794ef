// Looks surfels up in the sun's shadow map (slide "Sun shadow": the map does not cover all surfels; keep track whether a surfel has a
// valid sample). Runs when a map has been drawn.
//
//   sun_sample[s] = share of the surfel's cell that the sun reaches, of WHOLE_SAMPLE, or NO_SAMPLE
//   sampled_in[s] = number of the map that said so
//
// A surfel has a valid sample when all its taps lie in the map, and everything that could stand between it and the sun was drawn:
// when its ray to the sun is above the city's top (`top`, sector-local) by where the drawn geometry ends (`reach_height` higher up).
// Where it has none, its last sample is kept while its map is not older than `oldest_map`; then baked visibility takes over.
//
// A surfel stands for a cell of `place.w` metres, so TAPS x TAPS points spread over the cell are looked up, each in the texel that it
// falls into; the surfel's own plane is followed to that texel's centre, so that a slanted surface does not shade itself.
//
// Global size: surfels, one work-item each.
#include "layout.h"
#include "shadow_map.h"

// Below this cosine the sun gives a hundredth of what it would face on, and the plane's depth is too steep to follow.
#define LEAST_COSINE 0.01f
#define TAPS 4

__kernel void sample_shadow_map(
    const ShadowFrame frame,
    const uint surfels,
    __global const float4 *place, // sector-local position, and the cell's size
    __global const float *normal, // x of all surfels, then y, then z
    const uint normal_stride,
    __global const float *map,
    const float top,
    const float reach_height,
    const ushort this_map,
    const ushort oldest_map,
    __global uchar *sun_sample,
    __global ushort *sampled_in)
{
    const uint s = get_global_id(0);
    if (s >= surfels)
        return;
    const float nx = normal[s], ny = normal[normal_stride + s], nz = normal[2 * normal_stride + s];
    const float4 at = place[s];
    const float bias = SHADOW_BIAS_M + SHADOW_BIAS_CELLS * at.w;
    const float4 middle = map_from_sector(&frame, at.x + bias * nx, at.y + bias * ny, at.z + bias * nz);
    // The normal in the map's axes: the surfel's plane is n.x dx + n.y dy + n.z d(depth) = 0.
    const float across = nx * frame.across[0] + ny * frame.across[1] + nz * frame.across[2];
    const float down = nx * frame.down[0] + ny * frame.down[1] + nz * frame.down[2];
    const float cosine = nx * frame.to_sun[0] + ny * frame.to_sun[1] + nz * frame.to_sun[2];
    if (cosine <= LEAST_COSINE) {
        // The sun does not reach it, whatever stands around.
        sun_sample[s] = 0;
        sampled_in[s] = this_map;
        return;
    }
    // The cell seen from the sun: half as far as its size, and shortened along the direction in which it is slanted.
    const float spread = 0.5f * at.w * frame.texels_per_metre;
    const float level = 1.0f - cosine * cosine;
    const float shorten = level > 1e-6f ? (1.0f - cosine) / level : 0.0f;
    const bool covered = at.y + reach_height >= top && middle.x - spread >= 0.0f && middle.x + spread < frame.size
                         && middle.y - spread >= 0.0f && middle.y + spread < frame.size;
    if (!covered) {
        if (sampled_in[s] < oldest_map)
            sun_sample[s] = NO_SAMPLE;
        return;
    }
    const float depth_by_column = -across / cosine / frame.texels_per_metre, depth_by_row = -down / cosine / frame.texels_per_metre;
    int lit = 0;
    for (int i = 0; i < TAPS * TAPS; ++i) {
        const float a = ((i % TAPS + 0.5f) * (2.0f / TAPS) - 1.0f) * spread, b = ((i / TAPS + 0.5f) * (2.0f / TAPS) - 1.0f) * spread;
        const float slant = (a * across + b * down) * shorten;
        const float x = middle.x + a - slant * across, y = middle.y + b - slant * down;
        const int column = (int)x, row = (int)y;
        const float depth = middle.z + (column + 0.5f - middle.x) * depth_by_column + (row + 0.5f - middle.y) * depth_by_row;
        lit += depth >= map[row * (int)frame.size + column];
    }
    sun_sample[s] = (uchar)((lit * WHOLE_SAMPLE + TAPS * TAPS / 2) / (TAPS * TAPS));
    sampled_in[s] = this_map;
}
