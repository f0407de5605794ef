// Gathers the visibility bits of the baked directions around sun and moon into one byte per surfel. Runs when the sun or the moon
// has moved into another cell of the sun table, some ten times a day; every pass then reads one byte where it would read eight words.
//
//   bits 0..3: the sun's (first light's) four planes, bits 4..7: the moon's
//
// Global size: surfels, one work-item each.
//
// Defines: DIRECTIONAL_LIGHTS 1 or 2.
#ifndef DIRECTIONAL_LIGHTS
#error "DIRECTIONAL_LIGHTS is not defined"
#endif

#include "layout.h"

__kernel void select_planes(
    const uint surfels,
    __global const uint *sun_visibility,
    const uint words,
    __constant const DirectionalLight *lights,
    __global uchar *plane_bits)
{
    const uint surfel = get_global_id(0);
    if (surfel >= surfels)
        return;
    uint code = 0;
    for (int i = 0; i < DIRECTIONAL_LIGHTS * PLANES_PER_LIGHT; ++i) {
        const uint plane = lights[i / PLANES_PER_LIGHT].plane[i % PLANES_PER_LIGHT];
        code |= ((sun_visibility[plane * words + (surfel >> 5)] >> (surfel & 31)) & 1) << i;
    }
    plane_bits[surfel] = (uchar)code;
}
