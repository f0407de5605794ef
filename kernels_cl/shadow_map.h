// The sun's shadow map: where a point lies in it. Twin: gi_core/shadow_map_twin.py.
//
// The map is a square of texels that looks along the sun's light; a texel holds how far towards the sun the highest thing over its
// centre lies [m], so a point is in shadow when its own depth is less.
#ifndef SHADOW_MAP_H
#define SHADOW_MAP_H

#include "layout.h"

// Nothing is drawn over a texel that holds this.
#define NOTHING_DRAWN -1e30f

// (column, row, depth) of a sector-local point; the origin is the sector's, relative to the middle of the map.
inline float4 map_from_sector(const ShadowFrame *frame, float x, float y, float z)
{
    const float px = x + frame->origin[0], py = y + frame->origin[1], pz = z + frame->origin[2];
    const float half_size = 0.5f * frame->size;
    return (float4)(
        (px * frame->across[0] + py * frame->across[1] + pz * frame->across[2]) * frame->texels_per_metre + half_size,
        (px * frame->down[0] + py * frame->down[1] + pz * frame->down[2]) * frame->texels_per_metre + half_size,
        px * frame->to_sun[0] + py * frame->to_sun[1] + pz * frame->to_sun[2],
        0.0f);
}

#endif
