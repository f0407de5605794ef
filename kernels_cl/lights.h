// Lamps on a surfel: photometry and geometry. Twin: gi_core/lights_twin.py; the formulas are in MATH.md.
#ifndef LIGHTS_H
#define LIGHTS_H

#include "layout.h"

// Records hold no float3: its size is four floats.
#define LOAD3(v) ((float3)((v)[0], (v)[1], (v)[2]))
// From this many half diagonals on an area shines as a point: off by at most a part in a thousand, while the polygon's terms would
// cancel to noise.
#define AREA_IS_POINT_FROM 32.0f

// 1 at the lamp, smoothly 0 from its range on. Karis, "Real Shading in Unreal Engine 4", 2013.
inline float range_window(float squared_distance, float range)
{
    const float share = squared_distance / (range * range);
    const float fade = fmax(1.0f - share * share, 0.0f);
    return fade * fade;
}

// A spot's share of its intensity on the axis.
inline float spot_share(__constant LocalLight *light, float cosine)
{
    const float t = clamp((cosine - light->cos_outer) / (light->cos_inner - light->cos_outer), 0.0f, 1.0f);
    return t * t * (3.0f - 2.0f * t);
}

// Where a shadow ray to the light ends: the light itself, or the middle of a quarter of an area.
inline float3 light_sample(__constant LocalLight *light, uint ray)
{
    const float3 centre = LOAD3(light->position);
    if (light->kind != LOCAL_AREA)
        return centre;
    return centre + LOAD3(light->half_u) * (ray & 1 ? 0.5f : -0.5f) + LOAD3(light->half_v) * (ray & 2 ? 0.5f : -0.5f);
}

// Whether a light shines towards a surfel at all, however much is in between.
inline int reaches(__constant LocalLight *light, float3 position, float3 normal, float3 target)
{
    const float3 from_light = position - LOAD3(light->position);
    const float squared = dot(from_light, from_light);
    if (squared >= light->range * light->range || dot(normal, target - position) <= 0.0f)
        return 0;
    const float along = dot(LOAD3(light->axis), from_light);
    if (light->kind == LOCAL_SPOT)
        return along > light->cos_outer * sqrt(squared);
    return light->kind == LOCAL_POINT || along > 0.0f;
}

// Lambert's formula: half the sum, over the edges of what lies above the surfel's horizon, of the angle an edge subtends times the
// cosine of its plane's normal. Radiance 1 gives this irradiance. corner: four, relative to the surfel.
// Lambert, "Photometria", 1760; Arvo, "Applications of irradiance tensors", SIGGRAPH 1995.
inline float polygon_irradiance(const float3 *corner, float3 normal)
{
    // A plane cuts a rectangle to at most 5 corners; 8 are what rounding could make of a rectangle that lies in the plane.
    float3 kept[8];
    int count = 0;
    for (int i = 0; i < 4; ++i) {
        const float3 a = corner[i], b = corner[(i + 1) & 3];
        const float height_a = dot(a, normal), height_b = dot(b, normal);
        if (height_a >= 0.0f)
            kept[count++] = a;
        if (height_a * height_b < 0.0f)
            kept[count++] = a + (b - a) * (height_a / (height_a - height_b));
    }
    float sum = 0.0f;
    for (int i = 0; i < count; ++i) {
        const float3 a = kept[i], b = kept[i + 1 < count ? i + 1 : 0];
        const float3 turn = cross(a, b);
        const float sine = length(turn);
        if (sine > 0.0f)
            sum += dot(turn, normal) / sine * atan2(sine, dot(a, b));
    }
    return 0.5f * fabs(sum);
}

// Irradiance [lx] per unit of intensity [cd] (of an area: of radiance [cd m^-2]), nothing in between.
inline float unshadowed(__constant LocalLight *light, float3 position, float3 normal)
{
    const float3 to_light = LOAD3(light->position) - position;
    const float squared = dot(to_light, to_light);
    const float window = range_window(squared, light->range);
    const float distance = sqrt(squared);
    const float near = fmax(squared, LAMP_RADIUS_M * LAMP_RADIUS_M);
    const float cosine = fmax(dot(normal, to_light), 0.0f) / fmax(distance, LAMP_RADIUS_M);
    const float3 axis = LOAD3(light->axis);
    if (light->kind == LOCAL_POINT)
        return window * cosine / near;
    const float leaving = -dot(axis, to_light) / fmax(distance, LAMP_RADIUS_M);
    if (light->kind == LOCAL_SPOT)
        return window * spot_share(light, leaving) * cosine / near;
    if (leaving <= 0.0f)
        return 0.0f;
    const float3 u = LOAD3(light->half_u), v = LOAD3(light->half_v);
    if (squared > AREA_IS_POINT_FROM * AREA_IS_POINT_FROM * (dot(u, u) + dot(v, v)))
        return window * 4.0f * length(u) * length(v) * leaving * cosine / squared;
    const float3 corner[4] = { to_light + u + v, to_light - u + v, to_light - u - v, to_light + u - v };
    return window * polygon_irradiance(corner, normal);
}

#endif
