// Pass 1 of a relight (slide "Multiple bounces": use the irradiance from the previous frame).
//
//   brick exitance = brick direct + sum over the brick's bounces: albedo * face of a probe's cube                       [lx]
//   of harmonics                                                  albedo * sum over b: brick_basis[b] * probe_light[b]
//   patch exitance = the sky's
//
// Reads the probes' light of the previous pass and what light_bricks.cl made of the light, writes exitance[0 .. bricks + patches). A
// bounce is what collect_bounces.cl made of the surfels: how much of one face of one probe's cube, or of one probe's harmonics along the
// brick's mean basis, the brick sends on, per channel. Most bricks are flat and near one probe, and have one where they have six surfels;
// so a pass is a few multiplications a brick.
// One work-item per brick and sky patch, a fixed order: the same input gives the same bits.
//
// Defines: BASIS_SIZE, 6 is the cube. Harmonics may be negative where there is no light: nothing sends out less than none.
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif

#include "layout.h"

// Exitance of one brick. brick_basis is null for a cube.
inline float4 bounce_brick(
    const uint brick,
    __global const uint *bounce_starts,
    __global const Bounce *bounces,
    __global const float4 *direct,
    __global const float4 *probe_cube,
    __global const float *brick_basis)
{
    float4 sum = direct[brick];
    const uint end = bounce_starts[brick + 1];
#if BASIS_SIZE != 6
    // Two coefficients at a time: vectors of eight, and sums that do not wait for each other.
    __global const float *own = brick_basis + brick * BASIS_SIZE;
    float8 pair[BASIS_SIZE / 2];
    __attribute__((opencl_unroll_hint(BASIS_SIZE / 2)))
    for (uint b = 0; b < BASIS_SIZE / 2; ++b)
        pair[b] = (float8)((float4)(own[2 * b]), (float4)(own[2 * b + 1]));
#endif
    for (uint i = bounce_starts[brick]; i < end; ++i) {
        const float4 bounce = *(__global const float4 *)(bounces + i);
        __global const float4 *light = probe_cube + (as_uint(bounce.w) & ROW_BITS);
#if BASIS_SIZE == 6
        sum += bounce * *light; // the fourth component of a cube is 0
#else
        float8 two = pair[0] * (float8)(light[0], light[1]);
        __attribute__((opencl_unroll_hint(BASIS_SIZE / 2)))
        for (uint b = 1; b < BASIS_SIZE / 2; ++b)
            two += pair[b] * (float8)(light[2 * b], light[2 * b + 1]);
        float4 along = two.lo + two.hi;
#if BASIS_SIZE % 2
        along += own[BASIS_SIZE - 1] * light[BASIS_SIZE - 1];
#endif
        sum += bounce * along;
#endif
    }
#if BASIS_SIZE != 6
    sum = sum > 0.0f ? sum : 0.0f;
#endif
    return sum;
}

__kernel void bounce_bricks(
    const uint bricks,
    const uint patches,
    __global const uint *bounce_starts,
    __global const Bounce *bounces,
    __global const float4 *direct,
    __global const float4 *probe_cube,
    __global const float *brick_basis,
    __global float4 *exitance,
    __global const float4 *patch_exitance)
{
    const uint brick = get_global_id(0);
    if (brick < bricks)
        exitance[brick] = bounce_brick(brick, bounce_starts, bounces, direct, probe_cube, brick_basis);
    else if (brick < bricks + patches)
        exitance[brick] = patch_exitance[brick - bricks];
}
