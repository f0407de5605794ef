// Sums the light of up to MAX_LIGHTS_PER_LAUNCH lamps over what each surfel had before; more lamps are more launches.
//
//   surfel_light = before + sum over lamps: intensity * unshadowed irradiance * share of its shadow rays that arrive      [lx]
//
// One work-item for LANES surfels; no two write the same place, and lamps are added in their order: the same lamps give the same bits.
// When a few lamps have changed, only words of surfels near them are summed anew: elsewhere the sum would come out as it was.
#include "layout.h"
#include "lights.h"

// Share of the rays to an area that arrive, of those that start above a surfel's horizon.
inline float visible_share(__constant LocalLight *light, __global const uint *open, uint words, uint surfel, float3 position, float3 normal)
{
    float arrive = 0.0f, above = 0.0f;
    for (uint ray = 0; ray < AREA_SHADOW_RAYS; ++ray) {
        arrive += (float)((open[(light->first_plane + ray) * words + surfel / SURFELS_PER_WORD] >> surfel % SURFELS_PER_WORD) & 1);
        above += dot(normal, light_sample(light, ray) - position) > 0.0f ? 1.0f : 0.0f;
    }
    return above > 0.0f ? arrive / above : 0.0f;
}

__kernel void light_surfels(
    const uint surfels,
    const uint words,
    __global const SurfelWord *places,
    __constant LocalLight *lights,
    const uint light_count,
    __global const uint *open,
    __global const float4 *changed, // centre and range of lamps that have changed
    const uint changed_count,       // 0: all is summed anew
    __global const float4 *before,
    const uint has_before, // 0: from darkness
    __global float4 *surfel_light)
{
    const uint word = get_global_id(0) / GROUPS, group = get_global_id(0) % GROUPS;
    if (word >= words)
        return;
    __global const SurfelWord *here = places + word;
    int stale = changed_count == 0;
    for (uint i = 0; i < changed_count && !stale; ++i)
        stale = near_word(here, changed[i].xyz, changed[i].w);
    if (!stale)
        return;
    const Surfels s = load_surfels(here, group);
    const uint first = word * SURFELS_PER_WORD + group * LANES;
    float red[LANES], green[LANES], blue[LANES];
    for (uint lane = 0; lane < LANES; ++lane) {
        const float4 had = has_before && first + lane < surfels ? before[first + lane] : (float4)(0.0f);
        red[lane] = had.x;
        green[lane] = had.y;
        blue[lane] = had.z;
    }
    float8 r = vload8(0, red), g = vload8(0, green), b = vload8(0, blue);
    for (uint i = 0; i < light_count; ++i) {
        __constant LocalLight *light = lights + i;
        const uint rays = light->kind == LOCAL_AREA ? AREA_SHADOW_RAYS : 1;
        uint bits = 0;
        for (uint ray = 0; ray < rays; ++ray)
            bits |= open[(light->first_plane + ray) * words + word] >> (LANES * group) & LANES_MASK;
        if (!bits)
            continue;
        float8 arriving;
        if (light->kind == LOCAL_AREA) {
            float each[LANES];
            for (uint lane = 0; lane < LANES; ++lane) {
                each[lane] = 0.0f;
                if (bits >> lane & 1) {
                    const uint at = group * LANES + lane;
                    const float3 position = (float3)(here->position_x[at], here->position_y[at], here->position_z[at]);
                    const float3 normal = (float3)(here->normal_x[at], here->normal_y[at], here->normal_z[at]);
                    each[lane] = visible_share(light, open, words, first + lane, position, normal) * from_area(light, position, normal);
                }
            }
            arriving = vload8(0, each);
        } else {
            arriving = select((float8)(0.0f), from_point_or_spot(light, &s), lanes_of(bits));
        }
        r += arriving * light->intensity[0];
        g += arriving * light->intensity[1];
        b += arriving * light->intensity[2];
    }
    vstore8(r, 0, red);
    vstore8(g, 0, green);
    vstore8(b, 0, blue);
    for (uint lane = 0; lane < LANES && first + lane < surfels; ++lane)
        surfel_light[first + lane] = (float4)(red[lane], green[lane], blue[lane], 0.0f);
}
