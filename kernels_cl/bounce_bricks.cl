// Pass 1 of a relight (slide "Multiple bounces": use the irradiance from the previous frame).
//
//   brick exitance = brick direct + sum over the brick's bounces: albedo * face of a probe's cube       [lx]
//   patch exitance = the sky's
//
// Reads the probes' cubes of the previous pass and what light_bricks.cl made of the light, writes exitance[0 .. bricks + patches). A bounce is
// what collect_bounces.cl made of the surfels: how much of one face of one probe's cube the brick sends on, per channel. Most bricks
// are flat and near one probe, and have one where they have six surfels; so a pass is a few multiplications a brick.
// One work-item per brick and sky patch, a fixed order: the same input gives the same bits.
#include "layout.h"

__kernel void bounce_bricks(
    const uint bricks,
    const uint patches,
    __global const uint *bounce_starts,
    __global const Bounce *bounces,
    __global const float4 *direct,
    __global const float4 *probe_cube,
    __global float4 *exitance,
    __global const float4 *patch_exitance)
{
    const uint brick = get_global_id(0);
    if (brick >= bricks) {
        if (brick < bricks + patches)
            exitance[brick] = patch_exitance[brick - bricks];
        return;
    }
    float4 sum = direct[brick];
    const uint end = bounce_starts[brick + 1];
    for (uint i = bounce_starts[brick]; i < end; ++i) {
        const float4 bounce = *(__global const float4 *)(bounces + i);
        sum += bounce * probe_cube[as_uint(bounce.w) & ROW_BITS]; // the fourth component of a cube is 0
    }
    exitance[brick] = sum;
}
