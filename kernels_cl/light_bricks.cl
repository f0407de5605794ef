// What a relight does when the light has changed (slide "Relight surfels": calculate lighting at each surfel, average into bricks):
// the light that arrives at surfels straight from where it is made.
//
//   brick direct = glow  +  sun and moon: irradiance * mean over the brick's surfels of snowed-on albedo * sun_share     [lx]
//
// Glow is what lamps and emission make bricks send out (lamps_on_bricks.cl); a light's colour is the same for all surfels, so it
// multiplies the sum. Bounces are bounce_bricks.cl's. One work-item per brick; no two write the same place, and the order of every sum
// is fixed: the same input gives the same bits. Colours are float4 with an unused last component, which is three times as fast on a CPU
// as three scalars.
//
// Defines: DIRECTIONAL_LIGHTS 0..2, and 0 or 1: HAS_GLOW, HAS_SNOW. What is 0 has no code.
#ifndef DIRECTIONAL_LIGHTS
#error "DIRECTIONAL_LIGHTS is not defined"
#endif
#ifndef HAS_GLOW
#error "HAS_GLOW is not defined"
#endif
#ifndef HAS_SNOW
#error "HAS_SNOW is not defined"
#endif

#include "layout.h"
#include "snow.h"

// Direct exitance of one brick. Buffers of what is not there are null.
inline float4 light_brick(
    const uint brick,
    __global const float4 *glow,
    __global const uint *brick_starts,
    __global const float4 *surfel_albedo, // and the snow attribute
    __global const float *sun_share,
    const uint share_stride,
    const float snow,
    __constant const DirectionalLight *lights)
{
#if HAS_GLOW
    float4 sum = glow[brick];
#else
    float4 sum = (float4)(0.0f);
#endif
#if DIRECTIONAL_LIGHTS > 0
    const uint first = brick_starts[brick], end = brick_starts[brick + 1];
    float4 sun = (float4)(0.0f);
#if DIRECTIONAL_LIGHTS > 1
    float4 moon = (float4)(0.0f);
#endif
    for (uint s = first; s < end; ++s) {
#if HAS_SNOW
        const float4 albedo = snowed_albedo(surfel_albedo[s], snow * surfel_albedo[s].w);
#else
        const float4 albedo = surfel_albedo[s];
#endif
        sun += albedo * sun_share[s];
#if DIRECTIONAL_LIGHTS > 1
        moon += albedo * sun_share[share_stride + s];
#endif
    }
    float4 light = sun * *(__constant const float4 *)lights[0].irradiance;
#if DIRECTIONAL_LIGHTS > 1
    light += moon * *(__constant const float4 *)lights[1].irradiance;
#endif
    sum += light * (1.0f / (float)(end - first));
#endif
    return sum;
}

__kernel void light_bricks(
    const uint bricks,
    __global float4 *direct,
    __global const float4 *glow,
    __global const uint *brick_starts,
    __global const float4 *surfel_albedo,
    __global const float *sun_share,
    const uint share_stride,
    const float snow,
    __constant const DirectionalLight *lights)
{
    const uint brick = get_global_id(0);
    if (brick < bricks)
        direct[brick] = light_brick(brick, glow, brick_starts, surfel_albedo, sun_share, share_stride, snow, lights);
}
