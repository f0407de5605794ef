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
// A surfel stands for a cell of some size, so SHADOW_TAPS points spread over the cell are looked up, each in the texel that it falls
// into; the surfel's own plane is followed to that texel's centre, so that a slanted surface does not shade itself. The points are
// Hammersley's: seen from either side of the cell no two lie behind one another, so a shadow's edge along it moves by 1 / SHADOW_TAPS.
//
//      . . . . . . . o
//      . . . o . . . .      rows of the cell: the columns' numbers with their bits reversed
//      . . . . . o . .
//      . o . . . . . .
//      . . . . . . o .
//      . . o . . . . .
//      . . . . o . . .
//      o . . . . . . .
//
// Eight surfels at a time, as in sun_on_surfels.cl; arrays are padded to whole groups of eight. Global size: groups of eight surfels.
#include "layout.h"
#include "shadow_map.h"
#include "vectors.h"

// Below this cosine the sun gives a hundredth of what it would face on, and the plane's depth is too steep to follow.
#define LEAST_COSINE 0.01f

// Where the taps lie across and down the cell, as shares of half its size.
#define TAP(i, reversed) { (i + 0.5f) * (2.0f / SHADOW_TAPS) - 1.0f, (reversed + 0.5f) * (2.0f / SHADOW_TAPS) - 1.0f }
#if SHADOW_TAPS == 8
__constant const float taps[SHADOW_TAPS][2] = { TAP(0, 0), TAP(1, 4), TAP(2, 2), TAP(3, 6), TAP(4, 1), TAP(5, 5), TAP(6, 3), TAP(7, 7) };
#elif SHADOW_TAPS == 16
__constant const float taps[SHADOW_TAPS][2] = {
    TAP(0, 0), TAP(1, 8), TAP(2, 4), TAP(3, 12), TAP(4, 2), TAP(5, 10), TAP(6, 6), TAP(7, 14),
    TAP(8, 1), TAP(9, 9), TAP(10, 5), TAP(11, 13), TAP(12, 3), TAP(13, 11), TAP(14, 7), TAP(15, 15)
};
#else
#error "SHADOW_TAPS must be 8 or 16"
#endif

inline int any_of(int8 yes)
{
    const int4 fours = yes.lo | yes.hi;
    return (fours.x | fours.y | fours.z | fours.w) != 0;
}

__kernel void sample_shadow_map(
    const uint groups,
    const ShadowFrame frame,
    __global const float8 *place, // sector-local x of all groups, then y, then z, then the cells' sizes
    __global const float8 *normal, // x of all groups, then y, then z
    __global const float *map,
    const float top,
    const float reach_height,
    const ushort this_map,
    const ushort oldest_map,
    __global uchar8 *sun_sample,
    __global ushort8 *sampled_in)
{
    const uint group = get_global_id(0);
    if (group >= groups)
        return;
    const float8 nx = normal[group], ny = normal[groups + group], nz = normal[2 * groups + group];
    const float8 cosine = nx * frame.to_sun[0] + ny * frame.to_sun[1] + nz * frame.to_sun[2];
    const int8 faces = cosine > LEAST_COSINE;
    int8 covered = 0, lit = 0;
    if (any_of(faces)) {
        const float8 size = place[3 * groups + group], height = place[groups + group];
        const float8 bias = SHADOW_BIAS_M + SHADOW_BIAS_CELLS * size;
        const float8 x = place[group] + frame.origin[0] + bias * nx;
        const float8 y = height + frame.origin[1] + bias * ny;
        const float8 z = place[2 * groups + group] + frame.origin[2] + bias * nz;
        const float half_map = 0.5f * frame.size;
        const float8 column = (x * frame.across[0] + y * frame.across[1] + z * frame.across[2]) * frame.texels_per_metre + half_map;
        const float8 row = (x * frame.down[0] + y * frame.down[1] + z * frame.down[2]) * frame.texels_per_metre + half_map;
        const float8 depth = x * frame.to_sun[0] + y * frame.to_sun[1] + z * frame.to_sun[2];
        // The cell seen from the sun: half as far as its size, and shortened along the direction in which it is slanted.
        const float8 spread = 0.5f * size * frame.texels_per_metre;
        covered = faces & (height + reach_height >= top) & (column - spread >= 0.0f) & (column + spread < frame.size)
                  & (row - spread >= 0.0f) & (row + spread < frame.size);
        if (any_of(covered)) {
            // The normal in the map's axes: the surfel's plane is n.x dx + n.y dy + n.z d(depth) = 0.
            const float8 across = nx * frame.across[0] + ny * frame.across[1] + nz * frame.across[2];
            const float8 down = nx * frame.down[0] + ny * frame.down[1] + nz * frame.down[2];
            const float8 level = 1.0f - cosine * cosine;
            const float8 shorten = level > 1e-6f ? (1.0f - cosine) / level : (float8)(0.0f);
            const float8 by_texel = -1.0f / (cosine * frame.texels_per_metre);
            const float8 by_column = across * by_texel, by_row = down * by_texel;
            const float8 depth_at_zero = depth + (0.5f - column) * by_column + (0.5f - row) * by_row;
            for (int i = 0; i < SHADOW_TAPS; ++i) {
                const float8 a = taps[i][0] * spread, b = taps[i][1] * spread;
                const float8 slant = (a * across + b * down) * shorten;
                const int8 tap_column = TO_INTS(column + a - slant * across), tap_row = TO_INTS(row + b - slant * down);
                const int8 at = (tap_row * SHADOW_ROW_TEXELS + tap_column) & covered;
                const float8 over = (float8)(map[at.s0], map[at.s1], map[at.s2], map[at.s3], map[at.s4], map[at.s5], map[at.s6], map[at.s7]);
                lit -= depth_at_zero + TO_FLOATS(tap_column) * by_column + TO_FLOATS(tap_row) * by_row >= over;
            }
        }
    }
    // The sun does not reach what faces away, whatever stands around.
    const int8 valid = covered | ~faces;
    const int8 share = (lit * WHOLE_SAMPLE + SHADOW_TAPS / 2) / SHADOW_TAPS & faces;
    const int8 last_number = TO_INTS(sampled_in[group]);
    const int8 last = last_number < (int)oldest_map ? (int8)(NO_SAMPLE) : TO_INTS(sun_sample[group]);
    sun_sample[group] = TO_UCHARS(valid ? share : last);
    sampled_in[group] = TO_USHORTS(valid ? (int8)((int)this_map) : last_number);
}
