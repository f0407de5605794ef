// Sun and moon on a surfel, through the baked visibility bits. Twin: gi_core/relight_twin.py, directional_irradiance.
#ifndef SUN_H
#define SUN_H

#include "layout.h"

// Share of light `index` that reaches a surfel: the baked directions around the light, blended. `plane_bits` is the surfel's byte as
// select_planes.cl makes it; the light's table has the blend for each of the sixteen cases.
inline float directional_visibility(__constant const DirectionalLight *light, int index, uchar plane_bits)
{
    return light->visibility[(plane_bits >> (index * PLANES_PER_LIGHT)) & (VISIBILITY_CASES - 1)];
}

#endif
