// Pass 1 of a relight (slide "Relight surfels": calculate lighting at each surfel, average into bricks).
//
//   surfel irradiance = sum over sun and moon: irradiance * max(0, n . direction) * visibility
//                     + lamps                                                                  (surfel_light, made beforehand)
//                     + sum over its feedback probes: weight * probe's cube along n            (the previous pass: one more bounce)
//   surfel exitance   = snowed-on albedo * irradiance + pi * emission                          [lx]
//   brick exitance    = mean over the brick's surfels
//
// Reads the probes' cubes of the previous pass, writes exitance[0 .. bricks). One work-item per brick; no two write the same place,
// and the order of every sum is fixed: the same input gives the same bits. Colours are float4 with an unused last component, which
// is three times as fast on a CPU as three scalars.
// A surfel's albedo never exceeds ALBEDO_MAX < 1, with or without snow, which makes the feedback a contraction.
//
// Defines: DIRECTIONAL_LIGHTS 0..2, FEEDBACK_PROBES >= 1, and 0 or 1: HAS_FEEDBACK_WEIGHTS (otherwise every surfel has one probe of
// weight 1), HAS_EMISSION, HAS_SNOW, HAS_LAMPS. What is 0 has no code.
#ifndef DIRECTIONAL_LIGHTS
#error "DIRECTIONAL_LIGHTS is not defined"
#endif
#ifndef FEEDBACK_PROBES
#error "FEEDBACK_PROBES is not defined"
#endif
#ifndef HAS_FEEDBACK_WEIGHTS
#error "HAS_FEEDBACK_WEIGHTS is not defined"
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
#include "ambient_cube.h"
#include "sun.h"

__kernel void relight_bricks(
    const uint bricks,
    __global const uint *brick_starts,
    __global const Surfel *surfels,
    __global const ushort *feedback_probe,
#if HAS_FEEDBACK_WEIGHTS
    __global const float *feedback_weight,
#endif
    __global const float4 *probe_cube,
#if HAS_EMISSION
    __global const float *surfel_emission,
#endif
#if HAS_LAMPS
    __global const float4 *surfel_light,
#endif
#if DIRECTIONAL_LIGHTS > 0
    __global const uchar *plane_bits,
    __constant const DirectionalLight *lights,
#endif
    __global float4 *exitance
#if HAS_SNOW
    , const float snow
#endif
)
{
    const uint brick = get_global_id(0);
    if (brick >= bricks)
        return;
    const uint first = brick_starts[brick], end = brick_starts[brick + 1];
    float4 sum = (float4)(0.0f);
    for (uint s = first; s < end; ++s) {
        __global const float4 *surfel = (__global const float4 *)(surfels + s);
        const float4 normal = surfel[0]; // and the snow attribute
        float4 albedo = surfel[1];
#if HAS_SNOW
        albedo = mix(albedo, (float4)(SNOW_ALBEDO), snow * normal.w);
#endif
        float4 irradiance = (float4)(0.0f);
#if DIRECTIONAL_LIGHTS > 0
        __attribute__((opencl_unroll_hint(DIRECTIONAL_LIGHTS)))
        for (int i = 0; i < DIRECTIONAL_LIGHTS; ++i) {
            const float cosine = normal.x * lights[i].direction[0] + normal.y * lights[i].direction[1] + normal.z * lights[i].direction[2];
            const float lit = fmax(cosine, 0.0f) * directional_visibility(lights + i, i, plane_bits[s]);
            irradiance += lit * vload4(0, lights[i].irradiance);
        }
#endif
#if HAS_LAMPS
        irradiance += surfel_light[s];
#endif
#if HAS_FEEDBACK_WEIGHTS
        for (int k = 0; k < FEEDBACK_PROBES; ++k) {
            const uint slot = s * FEEDBACK_PROBES + k;
            irradiance += feedback_weight[slot] * evaluate_cube(probe_cube + (uint)feedback_probe[slot] * CUBE_FACES, normal);
        }
#else
        irradiance += evaluate_cube(probe_cube + (uint)feedback_probe[s] * CUBE_FACES, normal);
#endif
        sum += albedo * irradiance;
#if HAS_EMISSION
        sum += M_PI_F * (float4)(vload3(s, surfel_emission), 0.0f);
#endif
    }
    exitance[brick] = sum * (1.0f / (float)(end - first));
}
