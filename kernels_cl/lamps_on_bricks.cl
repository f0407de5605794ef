// What bricks send out of the light of lamps, and what shines by itself. Runs when a lamp or the snow has changed.
//
//   brick glow = mean over the brick's surfels of snowed-on albedo * surfel_light  +  pi * mean emission     [lx]
//
// One work-item per brick, a fixed order: the same input gives the same bits.
//
// Defines: 0 or 1: HAS_EMISSION, HAS_SNOW.
#ifndef HAS_EMISSION
#error "HAS_EMISSION is not defined"
#endif
#ifndef HAS_SNOW
#error "HAS_SNOW is not defined"
#endif

#include "layout.h"
#include "snow.h"

__kernel void lamps_on_bricks(
    const uint bricks,
    __global const uint *brick_starts,
    __global const float4 *surfel_albedo, // and the snow attribute
    __global const float4 *surfel_light,
    __global const float4 *brick_emission, // pi times the mean [lx], or null
    const float snow,
    __global float4 *glow)
{
    const uint brick = get_global_id(0);
    if (brick >= bricks)
        return;
    const uint first = brick_starts[brick], end = brick_starts[brick + 1];
    float4 sum = (float4)(0.0f);
    for (uint s = first; s < end; ++s) {
#if HAS_SNOW
        sum += snowed_albedo(surfel_albedo[s], snow * surfel_albedo[s].w) * surfel_light[s];
#else
        sum += surfel_albedo[s] * surfel_light[s];
#endif
    }
    sum *= 1.0f / (float)(end - first);
#if HAS_EMISSION
    sum += brick_emission[brick];
#endif
    glow[brick] = sum;
}
