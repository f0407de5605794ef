// Sun and moon on a surfel, through the baked visibility bits. Twin: gi_core/relight_twin.py, directional_irradiance.
#ifndef SUN_H
#define SUN_H

#include "layout.h"

// Share of a directional light that reaches a surfel: the baked directions around the light, blended.
// A plane holds one bit per surfel. `plane` are the light's four planes.
inline float directional_visibility(__global const uint *const *plane, __constant const DirectionalLight *light, uint surfel)
{
    const uint word = surfel >> 5, bit = surfel & 31;
    float visibility = 0.0f;
    __attribute__((opencl_unroll_hint(PLANES_PER_LIGHT)))
    for (int i = 0; i < PLANES_PER_LIGHT; ++i)
        visibility += light->plane_weight[i] * (float)((plane[i][word] >> bit) & 1);
    return visibility;
}

#endif
