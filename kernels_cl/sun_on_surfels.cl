// How much of sun and moon each surfel takes: cosine times visibility. Runs when either has moved.
//
//   sun_share[light][s] = max(0, n . direction) * visibility
//   visibility          = sum of plane_weight over the four baked directions around the light that the surfel sees, or,
//                         where it has one, the surfel's sample of the sun's shadow map
//
// Eight surfels at a time, whose bits of one plane are one byte; arrays are padded to whole groups of eight.
// Global size: groups of eight surfels.
//
// No built-in functions in loops, here and in the other passes: PoCL 3.0 calls them instead of inlining them, and every call puts all
// vectors on the stack. Operators on vectors, `?:` among them, are instructions.
//
// Defines: DIRECTIONAL_LIGHTS 1 or 2; HAS_SUN_MAP 0 or 1: surfels have samples of the sun's shadow map.
#ifndef DIRECTIONAL_LIGHTS
#error "DIRECTIONAL_LIGHTS is not defined"
#endif
#ifndef HAS_SUN_MAP
#error "HAS_SUN_MAP is not defined"
#endif

#include "layout.h"
#include "vectors.h"

// sun_share of one group of eight surfels. Buffers of what is not there are null.
inline void sun_on_group(
    const uint group,
    const uint groups,
    __global const float8 *normal, // x of all groups, then y, then z
    __global const uchar *sun_visibility,
    const uint plane_bytes,
    __global const uchar8 *sun_sample,
    __global float8 *sun_share,
    __constant const DirectionalLight *lights)
{
    const float8 x = normal[group], y = normal[groups + group], z = normal[2 * groups + group];
    const int8 bit = (int8)(1, 2, 4, 8, 16, 32, 64, 128);
    __attribute__((opencl_unroll_hint(DIRECTIONAL_LIGHTS)))
    for (int i = 0; i < DIRECTIONAL_LIGHTS; ++i) {
        float8 visible = (float8)(0.0f);
        __attribute__((opencl_unroll_hint(PLANES_PER_LIGHT)))
        for (int p = 0; p < PLANES_PER_LIGHT; ++p) {
            const int seen = sun_visibility[lights[i].plane[p] * plane_bytes + group];
            visible += as_float8((((int8)(seen) & bit) != 0) & as_int8((float8)(lights[i].plane_weight[p])));
        }
#if HAS_SUN_MAP
        if (i == 0) {
            const int8 sample = TO_INTS(sun_sample[group]);
            visible = sample == NO_SAMPLE ? visible : TO_FLOATS(sample) * (1.0f / WHOLE_SAMPLE);
        }
#endif
        const float8 cosine = x * lights[i].direction[0] + y * lights[i].direction[1] + z * lights[i].direction[2];
        sun_share[i * groups + group] = (cosine > 0.0f ? cosine : (float8)(0.0f)) * visible;
    }
}

__kernel void sun_on_surfels(
    const uint groups,
    __global const float8 *normal,
    __global const uchar *sun_visibility,
    const uint plane_bytes,
    __global const uchar8 *sun_sample,
    __global float8 *sun_share,
    __constant const DirectionalLight *lights)
{
    const uint group = get_global_id(0);
    if (group < groups)
        sun_on_group(group, groups, normal, sun_visibility, plane_bytes, sun_sample, sun_share, lights);
}
