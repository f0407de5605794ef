// What a relight does when the light has changed (slide "Relight surfels": calculate lighting at each surfel, average into bricks):
// the light that arrives at surfels straight from where it is made.
//
//   surfel exitance = snowed-on albedo * (sun and moon: irradiance * sun_share  +  lamps: surfel_light)  +  pi * emission     [lx]
//   brick direct    = mean over the brick's surfels
//
// A light's colour is the same for all surfels, so it multiplies the sum. Bounces are bounce_bricks.cl's. One work-item per brick; no
// two write the same place, and the order of every sum is fixed: the same input gives the same bits. Colours are float4 with an unused
// last component, which is three times as fast on a CPU as three scalars.
//
// Defines: DIRECTIONAL_LIGHTS 0..2, and 0 or 1: HAS_EMISSION, HAS_SNOW, HAS_LAMPS. What is 0 has no code.
#ifndef DIRECTIONAL_LIGHTS
#error "DIRECTIONAL_LIGHTS is not defined"
#endif
#ifndef HAS_EMISSION
#error "HAS_EMISSION is not defined"
#endif
#ifndef HAS_SNOW
#error "HAS_SNOW is not defined"
#endif
#ifndef HAS_LAMPS
#error "HAS_LAMPS is not defined"
#endif

#include "layout.h"
#include "snow.h"

__kernel void light_bricks(
    const uint bricks,
    __global const uint *brick_starts,
    __global const float4 *surfel_albedo, // and the snow attribute
#if HAS_EMISSION
    __global const float4 *brick_emission, // pi times the mean [lx]
#endif
#if HAS_LAMPS
    __global const float4 *surfel_light,
#endif
    __global float4 *direct
#if HAS_SNOW
    , const float snow
#endif
#if DIRECTIONAL_LIGHTS > 0
    , __global const float *sun_share,
    const uint share_stride,
    __constant const DirectionalLight *lights
#endif
)
{
    const uint brick = get_global_id(0);
    if (brick >= bricks)
        return;
    const uint first = brick_starts[brick], end = brick_starts[brick + 1];
#if DIRECTIONAL_LIGHTS > 0
    float4 sun = (float4)(0.0f);
#endif
#if DIRECTIONAL_LIGHTS > 1
    float4 moon = (float4)(0.0f);
#endif
    float4 sum = (float4)(0.0f);
    for (uint s = first; s < end; ++s) {
#if HAS_SNOW
        const float4 albedo = snowed_albedo(surfel_albedo[s], snow * surfel_albedo[s].w);
#else
        const float4 albedo = surfel_albedo[s];
#endif
#if DIRECTIONAL_LIGHTS > 0
        sun += albedo * sun_share[s];
#endif
#if DIRECTIONAL_LIGHTS > 1
        moon += albedo * sun_share[share_stride + s];
#endif
#if HAS_LAMPS
        sum += albedo * surfel_light[s];
#endif
    }
#if DIRECTIONAL_LIGHTS > 0
    sum += sun * *(__constant const float4 *)lights[0].irradiance;
#endif
#if DIRECTIONAL_LIGHTS > 1
    sum += moon * *(__constant const float4 *)lights[1].irradiance;
#endif
    sum *= 1.0f / (float)(end - first);
#if HAS_EMISSION
    sum += brick_emission[brick];
#endif
    direct[brick] = sum;
}
