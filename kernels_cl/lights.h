// Lamps on a surfel: photometry and geometry. Twin: gi_core/lights_twin.py; the formulas are in MATH.md.
#ifndef LIGHTS_H
#define LIGHTS_H

#include "layout.h"

// Records hold no float3: its size is four floats.
#define LOAD3(v) ((float3)((v)[0], (v)[1], (v)[2]))
// From this many half diagonals on an area shines as a point: off by at most a part in a thousand, while the polygon's terms would
// cancel to noise.
#define AREA_IS_POINT_FROM 32.0f

// Surfels are lit eight at a time: float16 crashes PoCL 3.0 on AVX-512 machines.
#define LANES 8
#define LANES_MASK 0xffu
#define GROUPS (SURFELS_PER_WORD / LANES)

// LANES neighbouring surfels. Those past a sector's last have no normal, and so nothing shines at them.
typedef struct {
    float8 x, y, z, normal_x, normal_y, normal_z;
} Surfels;

inline Surfels load_surfels(__global const SurfelWord *word, uint group)
{
    const Surfels s = { vload8(group, word->position_x), vload8(group, word->position_y), vload8(group, word->position_z),
                        vload8(group, word->normal_x),   vload8(group, word->normal_y),   vload8(group, word->normal_z) };
    return s;
}

// -1 in each lane whose bit is set, and back.
inline int8 lanes_of(uint bits)
{
    return ((int8)((int)bits) & (int8)(1, 2, 4, 8, 16, 32, 64, 128)) != 0;
}

inline uint bits_of(int8 lanes)
{
    const int8 bits = lanes & (int8)(1, 2, 4, 8, 16, 32, 64, 128);
    const int4 four = bits.lo | bits.hi;
    return (uint)(four.x | four.y | four.z | four.w);
}

// Whether any lane is on; PoCL's any() goes lane by lane.
inline int some_of(int8 lanes)
{
    const int4 four = lanes.lo | lanes.hi;
    const int2 two = four.lo | four.hi;
    return (two.x | two.y) != 0;
}

// The least and the greatest of 0 and the lanes that are on.
inline float least_of(float8 value, int8 on)
{
    const float8 kept = select((float8)(0.0f), value, on);
    const float4 four = fmin(kept.lo, kept.hi);
    return fmin(fmin(four.x, four.y), fmin(four.z, four.w));
}

inline float most_of(float8 value, int8 on)
{
    return -least_of(-value, on);
}

// Whether a sphere may hold a surfel of a word; a little too often, so that rounding leaves none out.
inline int near_word(__global const SurfelWord *word, float3 centre, float radius)
{
    const float3 beyond = centre - clamp(centre, LOAD3(word->low), LOAD3(word->high));
    return dot(beyond, beyond) <= radius * radius * 1.001f;
}

// 1 at the lamp, smoothly 0 from its range on. Karis, "Real Shading in Unreal Engine 4", 2013.
inline float8 range_window(float8 squared_distance, float range)
{
    const float8 share = squared_distance / (range * range);
    const float8 fade = fmax(1.0f - share * share, 0.0f);
    return fade * fade;
}

// Where a shadow ray to the light ends: the light itself, or the middle of a quarter of an area.
inline float3 light_sample(__constant LocalLight *light, uint ray)
{
    const float3 centre = LOAD3(light->position);
    if (light->kind != LOCAL_AREA)
        return centre;
    return centre + LOAD3(light->half_u) * (ray & 1 ? 0.5f : -0.5f) + LOAD3(light->half_v) * (ray & 2 ? 0.5f : -0.5f);
}

// Whether a light shines towards surfels at all, however much is in between: -1 where it does.
inline int8 reaches(__constant LocalLight *light, const Surfels *s, float3 target)
{
    const float8 x = s->x - light->position[0], y = s->y - light->position[1], z = s->z - light->position[2];
    const float8 squared = x * x + y * y + z * z;
    const float8 facing = s->normal_x * (target.x - s->x) + s->normal_y * (target.y - s->y) + s->normal_z * (target.z - s->z);
    const int8 near = (squared < light->range * light->range) & (facing > 0.0f);
    if (light->kind == LOCAL_POINT)
        return near;
    const float8 along = x * light->axis[0] + y * light->axis[1] + z * light->axis[2];
    return near & (light->kind == LOCAL_SPOT ? along > light->cos_outer * sqrt(squared) : along > 0.0f);
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

// Irradiance [lx] per unit of intensity [cd] of a point or a spot, nothing in between.
inline float8 from_point_or_spot(__constant LocalLight *light, const Surfels *s)
{
    const float8 x = light->position[0] - s->x, y = light->position[1] - s->y, z = light->position[2] - s->z;
    const float8 squared = x * x + y * y + z * z;
    const float8 bounded = fmax(sqrt(squared), LAMP_RADIUS_M);
    const float8 cosine = fmax(s->normal_x * x + s->normal_y * y + s->normal_z * z, 0.0f) / bounded;
    const float8 value = range_window(squared, light->range) * cosine / (bounded * bounded);
    if (light->kind == LOCAL_POINT)
        return value;
    const float8 leaving = -(light->axis[0] * x + light->axis[1] * y + light->axis[2] * z) / bounded;
    const float8 edge = clamp((leaving - light->cos_outer) / (light->cos_inner - light->cos_outer), 0.0f, 1.0f);
    return value * edge * edge * (3.0f - 2.0f * edge);
}

// Irradiance [lx] per unit of radiance [cd m^-2] of an area, nothing in between.
inline float from_area(__constant LocalLight *light, float3 position, float3 normal)
{
    const float3 to_light = LOAD3(light->position) - position;
    const float squared = dot(to_light, to_light), bounded = fmax(sqrt(squared), LAMP_RADIUS_M);
    const float share = squared / (light->range * light->range), fade = fmax(1.0f - share * share, 0.0f);
    const float leaving = -dot(LOAD3(light->axis), to_light) / bounded;
    if (leaving <= 0.0f)
        return 0.0f;
    const float3 u = LOAD3(light->half_u), v = LOAD3(light->half_v);
    if (squared > AREA_IS_POINT_FROM * AREA_IS_POINT_FROM * (dot(u, u) + dot(v, v))) {
        const float cosine = fmax(dot(normal, to_light), 0.0f) / bounded;
        return fade * fade * 4.0f * length(u) * length(v) * leaving * cosine / squared;
    }
    const float3 corner[4] = { to_light + u + v, to_light - u + v, to_light - u - v, to_light + u - v };
    return fade * fade * polygon_irradiance(corner, normal);
}

#endif
