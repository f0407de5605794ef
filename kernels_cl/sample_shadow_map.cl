// Looks surfels up in the sun's shadow map (slide "Sun shadow": the map does not cover all surfels; keep track whether a surfel has a
// valid sample). Runs when a map has been drawn.
//
//   sun_sample[s] = share of the surfel's cell that the sun reaches, of WHOLE_SAMPLE, or NO_SAMPLE
//   sampled_in[s] = number of the sector's look at a map that said so
//
// A surfel has a valid sample when all its taps lie in the map, and everything that could stand between it and the sun was drawn:
// when its ray to the sun is above the city's top (`top`, sector-local) by where the drawn geometry ends (`reach_height` higher up).
// Where it has none, its last sample is kept while its look is not older than `oldest_look`; then baked visibility takes over.
//
// A surfel stands for a cell of some size, so SHADOW_TAPS points spread over the cell are looked up, each in the two texels of a row that
// are nearest to it; the surfel's own plane is followed to those texels' centres, so that a slanted surface does not shade itself. Two
// neighbours are one read, and reads are what this kernel's time goes into. No tap lies in another's row or column:
//
//      . . . o
//      . o . .
//      . . o .
//      o . . .
//
// Eight surfels at a time, as in sun_on_surfels.cl; arrays are padded to whole groups of eight. Global size: groups of eight surfels.
#include "layout.h"
#include "shadow_map.h"
#include "vectors.h"

// Below this cosine the sun gives a hundredth of what it would face on, and the plane's depth is too steep to follow.
#define LEAST_COSINE 0.01f

// Where the taps lie across and down the cell, as shares of half its size.
__constant const float tap_across[SHADOW_TAPS] = { -0.75f, -0.25f, 0.25f, 0.75f };
__constant const float tap_down[SHADOW_TAPS] = { -0.75f, 0.25f, -0.25f, 0.75f };

// Two neighbouring texels.
typedef long loose_pair_t __attribute__((aligned(4)));
#define PAIR(at) (*(__global const loose_pair_t *)(map + (at)))

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
    const ushort this_look,
    const ushort oldest_look,
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
            // A tap at (a, b) of the cell lies at a * (to_x, turn) + b * (turn, to_y) from its middle.
            const float8 shorten = spread / (1.0f + cosine);
            const float8 to_x = spread - across * across * shorten, turn = -across * down * shorten;
            const float8 to_y = spread - down * down * shorten;
            const float8 by_texel = -1.0f / (cosine * frame.texels_per_metre);
            const float8 by_column = across * by_texel, by_row = down * by_texel;
            const float8 depth_at_zero = depth + (0.5f - column) * by_column + (0.5f - row) * by_row;
            for (int i = 0; i < SHADOW_TAPS; ++i) {
                const int8 tap_column = TO_INTS(column - 0.5f + tap_across[i] * to_x + tap_down[i] * turn);
                const int8 tap_row = TO_INTS(row + tap_across[i] * turn + tap_down[i] * to_y);
                const int8 at = (tap_row * SHADOW_ROW_TEXELS + tap_column) & covered;
                // In this order of lanes, taking pairs apart moves nothing from one half of a vector to the other.
                const float8 p = as_float8((long4)(PAIR(at.s0), PAIR(at.s1), PAIR(at.s4), PAIR(at.s5)));
                const float8 q = as_float8((long4)(PAIR(at.s2), PAIR(at.s3), PAIR(at.s6), PAIR(at.s7)));
                const float8 left = (float8)(p.s0, p.s2, q.s0, q.s2, p.s4, p.s6, q.s4, q.s6);
                const float8 right = (float8)(p.s1, p.s3, q.s1, q.s3, p.s5, p.s7, q.s5, q.s7);
                const float8 own = depth_at_zero + TO_FLOATS(tap_column) * by_column + TO_FLOATS(tap_row) * by_row;
                lit -= own >= left;
                lit -= own + by_column >= right;
            }
        }
    }
    // The sun does not reach what faces away, whatever stands around.
    const int8 valid = covered | ~faces;
    const int8 share = (lit * WHOLE_SAMPLE + SHADOW_TAPS) / (2 * SHADOW_TAPS) & faces;
    const int8 last_number = TO_INTS(sampled_in[group]);
    const int8 last = last_number < (int)oldest_look ? (int8)(NO_SAMPLE) : TO_INTS(sun_sample[group]);
    sun_sample[group] = TO_UCHARS(valid ? share : last);
    sampled_in[group] = TO_USHORTS(valid ? (int8)((int)this_look) : last_number);
}
