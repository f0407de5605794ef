// All of a relight in one work-item: the kernels of sun_on_surfels.cl, light_bricks.cl, bounce_bricks.cl and gather_probes.cl one after the
// other, with the same results to the bit.
//
// For processors. Between two kernels of a queue PoCL takes some 10 us to put threads to sleep and to wake them, as long as a kernel works
// on half a sector; here a sector's data stay with one core, and another has the tick's other sector.
//
// The global id is 2 * passes, and one more if the light is another than at the last launch.
//
// Defines: those of the four.
#include "bounce_bricks.cl"
#include "gather_probes.cl"
#include "light_bricks.cl"
#if DIRECTIONAL_LIGHTS > 0
#include "sun_on_surfels.cl"
#endif

__kernel void relight_sector(
    const uint groups,
    __global const float8 *normal,
    __global const uchar *sun_visibility,
    const uint plane_bytes,
    __global const uchar8 *sun_sample,
    __global float *sun_share,
    const uint bricks,
    __global float4 *direct,
    __global const float4 *glow,
    __global const uint *brick_starts,
    __global const float4 *surfel_albedo,
    const float snow,
    const uint patches,
    __global const uint *bounce_starts,
    __global const Bounce *bounces,
    __global const float *brick_basis,
    __global float4 *exitance,
    const uint probes,
    __global const uint *factor_starts,
    __global const uint *sky_starts,
    __global const uint *factor_source,
    __global const uchar *factor_code,
    __global const float *factor_scale,
    __global float4 *probe_cube,
    __constant const DirectionalLight *lights,
    __global const float4 *patch_exitance)
{
    const uint passes = get_global_id(0) / 2;
    const bool is_lit_anew = get_global_id(0) % 2;
    if (is_lit_anew) {
#if DIRECTIONAL_LIGHTS > 0
        for (uint group = 0; group < groups; ++group)
            sun_on_group(group, groups, normal, sun_visibility, plane_bytes, sun_sample, (__global float8 *)sun_share, lights);
#endif
        for (uint brick = 0; brick < bricks; ++brick)
            direct[brick] = light_brick(brick, glow, brick_starts, surfel_albedo, sun_share, 8 * groups, snow, lights);
    }
    for (uint patch = 0; patch < patches; ++patch)
        exitance[bricks + patch] = patch_exitance[patch];
    for (uint pass = 0; pass < passes; ++pass) {
        for (uint brick = 0; brick < bricks; ++brick)
            exitance[brick] = bounce_brick(brick, bounce_starts, bounces, direct, probe_cube, brick_basis);
        for (uint probe = 0; probe < probes; ++probe)
            gather_probe(probe, factor_starts, sky_starts, factor_source, factor_code, factor_scale, exitance, probe_cube);
    }
}
