// Which surfels see which lamps: any-hit rays against the triangles near each lamp. Runs when a lamp or what it lights has changed.
//
// A lamp has one plane of bits, an area AREA_SHADOW_RAYS; as with the sun, bit s % 32 of word s // 32 says whether surfel s sees it.
// Bits of surfels that a lamp doesn't shine at are 0.
//
// Global size: (words, planes), one work-item per word. Surfels of a word are neighbours (a brick lies in one 4 m cell), so a box
// about their 32 rays is slim, and most triangles are passed by one look at it:
//
//     lamp *--___            +----+  a triangle outside of the box
//          \     ---___      |    |
//           \    box   --___ +----+
//            s s s s s s s s
#include "layout.h"
#include "lights.h"

// Rays that meet an edge exactly must not slip between the two triangles that share it.
#define EDGE_SLACK 1e-5f

// Whether a triangle lies on the way from `start` along `way`. Moller and Trumbore, "Fast, minimum storage ray/triangle intersection",
// 1997. Both sides block. No comparison holds for NaN, so a degenerate triangle blocks nothing.
inline int blocks(float3 start, float3 way, float3 corner, float3 edge_a, float3 edge_b)
{
    const float3 p = cross(way, edge_b);
    const float determinant = dot(edge_a, p);
    if (fabs(determinant) < 1e-12f)
        return 0;
    const float inverse = 1.0f / determinant;
    const float3 from_corner = start - corner;
    const float u = dot(from_corner, p) * inverse;
    const float3 q = cross(from_corner, edge_a);
    const float v = dot(way, q) * inverse;
    const float t = dot(edge_b, q) * inverse;
    return u >= -EDGE_SLACK && v >= -EDGE_SLACK && u + v <= 1.0f + EDGE_SLACK && t >= 0.0f && t <= 1.0f;
}

__kernel void trace_shadows(
    const uint surfels,
    const uint words,
    __global const SurfelPlace *place,
    __constant LocalLight *lights,
    __global const uint *plane_light,
    __global const uint *triangle_starts,
    __global const ShadowTriangle *triangles,
    __global uint *open)
{
    const uint word = get_global_id(0), plane = get_global_id(1);
    if (word >= words)
        return;
    const uint index = plane_light[plane];
    __constant LocalLight *light = lights + index;
    const float3 target = light_sample(light, plane - light->first_plane);
    uint unblocked = 0;
    float3 low = target, high = target;
    for (uint i = 0; i < 32 && word * 32 + i < surfels; ++i) {
        const float3 position = LOAD3(place[word * 32 + i].position), normal = LOAD3(place[word * 32 + i].normal);
        if (!reaches(light, position, normal, target))
            continue;
        const float3 start = position + normal * SHADOW_START_M;
        low = fmin(low, start);
        high = fmax(high, start);
        unblocked |= 1u << i;
    }
    for (uint t = triangle_starts[index]; t < triangle_starts[index + 1] && unblocked; ++t) {
        const float3 corner = LOAD3(triangles[t].corner), edge_a = LOAD3(triangles[t].edge_a), edge_b = LOAD3(triangles[t].edge_b);
        const float3 least = corner + fmin(fmin(edge_a, edge_b), 0.0f), most = corner + fmax(fmax(edge_a, edge_b), 0.0f);
        if (any(isgreater(least, high)) || any(isless(most, low)))
            continue;
        for (uint i = 0; i < 32; ++i) {
            if (!(unblocked >> i & 1))
                continue;
            const float3 start = LOAD3(place[word * 32 + i].position) + LOAD3(place[word * 32 + i].normal) * SHADOW_START_M;
            const float3 way = target - start;
            const float distance = length(way);
            if (distance > SHADOW_END_M && blocks(start, way * (1.0f - SHADOW_END_M / distance), corner, edge_a, edge_b))
                unblocked &= ~(1u << i);
        }
    }
    open[plane * words + word] = unblocked;
}
