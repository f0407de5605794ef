// Pass 1 of a relight (slide "Relight surfels": calculate lighting at each surfel, average into bricks).
//
//   surfel irradiance = sum over sun and moon: irradiance * max(0, n . direction) * visibility
//                     + sum over its feedback probes: weight * probe's cube along n        (the previous pass: one more bounce)
//   surfel exitance   = albedo * irradiance + pi * emission                                 [lx]
//   brick exitance    = mean over the brick's surfels
//
// Reads the probes' cubes of the previous pass, writes exitance[0 .. bricks). One work-item per brick; no two write the same place,
// and the order of every sum is fixed: the same input gives the same bits.
// A surfel's albedo never exceeds ALBEDO_MAX < 1, which makes the feedback a contraction.
//
// Defines: DIRECTIONAL_LIGHTS 0..2, FEEDBACK_PROBES >= 1, HAS_EMISSION 0 or 1. What is 0 has no code.
#ifndef DIRECTIONAL_LIGHTS
#error "DIRECTIONAL_LIGHTS is not defined"
#endif
#ifndef FEEDBACK_PROBES
#error "FEEDBACK_PROBES is not defined"
#endif
#ifndef HAS_EMISSION
#error "HAS_EMISSION is not defined"
#endif

#include "layout.h"
#include "ambient_cube.h"
#include "sun.h"

__kernel void relight_bricks(
    const uint bricks,
    __global const uint *brick_starts,
    __global const Surfel *surfels,
    __global const ushort *feedback_probe,
    __global const float *feedback_weight,
    __global const float *probe_cube,
#if HAS_EMISSION
    __global const float *surfel_emission,
#endif
#if DIRECTIONAL_LIGHTS > 0
    __global const uint *sun_visibility,
    const uint words,
    __constant DirectionalLight *lights,
#endif
    __global float4 *exitance)
{
    const uint brick = get_global_id(0);
    if (brick >= bricks)
        return;
    const uint first = brick_starts[brick], end = brick_starts[brick + 1];
    float r = 0.0f, g = 0.0f, b = 0.0f;
    for (uint s = first; s < end; ++s) {
        __global const Surfel *surfel = surfels + s;
        const float nx = surfel->normal[0], ny = surfel->normal[1], nz = surfel->normal[2];
        float er = 0.0f, eg = 0.0f, eb = 0.0f;
#if DIRECTIONAL_LIGHTS > 0
        for (int i = 0; i < DIRECTIONAL_LIGHTS; ++i) {
            const float cosine = nx * lights[i].direction[0] + ny * lights[i].direction[1] + nz * lights[i].direction[2];
            if (cosine > 0.0f) {
                const float lit = cosine * directional_visibility(sun_visibility, words, s, lights + i);
                er += lit * lights[i].irradiance[0];
                eg += lit * lights[i].irradiance[1];
                eb += lit * lights[i].irradiance[2];
            }
        }
#endif
        for (int k = 0; k < FEEDBACK_PROBES; ++k) {
            const uint slot = s * FEEDBACK_PROBES + k;
            const float weight = feedback_weight[slot];
            const float3 bounced = evaluate_cube(probe_cube + (uint)feedback_probe[slot] * 18, nx, ny, nz);
            er += weight * bounced.x;
            eg += weight * bounced.y;
            eb += weight * bounced.z;
        }
        r += surfel->albedo[0] * er;
        g += surfel->albedo[1] * eg;
        b += surfel->albedo[2] * eb;
#if HAS_EMISSION
        r += M_PI_F * surfel_emission[3 * s];
        g += M_PI_F * surfel_emission[3 * s + 1];
        b += M_PI_F * surfel_emission[3 * s + 2];
#endif
    }
    const float share = 1.0f / (float)(end - first);
    exitance[brick] = (float4)(r * share, g * share, b * share, 0.0f);
}
