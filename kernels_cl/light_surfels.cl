// Adds the light of up to MAX_LIGHTS_PER_LAUNCH lamps to what each surfel has; more lamps are more launches.
//
//   surfel_light += sum over lamps: intensity * unshadowed irradiance * share of its shadow rays that arrive      [lx]
//
// One work-item per surfel; no two write the same place, and lamps are added in their order: the same lamps give the same bits.
#include "layout.h"
#include "lights.h"

// Share of the rays to a light that arrive, of those that start above the surfel's horizon.
inline float visible_share(__constant LocalLight *light, __global const uint *open, uint words, uint surfel, float3 position, float3 normal)
{
    const uint word = surfel >> 5, bit = surfel & 31;
    if (light->kind != LOCAL_AREA)
        return (float)((open[light->first_plane * words + word] >> bit) & 1);
    float arrive = 0.0f, above = 0.0f;
    for (uint ray = 0; ray < AREA_SHADOW_RAYS; ++ray) {
        arrive += (float)((open[(light->first_plane + ray) * words + word] >> bit) & 1);
        above += dot(normal, light_sample(light, ray) - position) > 0.0f ? 1.0f : 0.0f;
    }
    return above > 0.0f ? arrive / above : 0.0f;
}

__kernel void light_surfels(
    const uint surfels,
    const uint words,
    __global const SurfelPlace *place,
    __constant LocalLight *lights,
    const uint light_count,
    __global const uint *open,
    __global float4 *surfel_light)
{
    const uint s = get_global_id(0);
    if (s >= surfels)
        return;
    const float3 position = LOAD3(place[s].position), normal = LOAD3(place[s].normal);
    float4 sum = surfel_light[s];
    for (uint i = 0; i < light_count; ++i) {
        const float share = visible_share(lights + i, open, words, s, position, normal);
        if (share > 0.0f) {
            const float arriving = share * unshadowed(lights + i, position, normal);
            sum.x += arriving * lights[i].intensity[0];
            sum.y += arriving * lights[i].intensity[1];
            sum.z += arriving * lights[i].intensity[2];
        }
    }
    surfel_light[s] = sum;
}
