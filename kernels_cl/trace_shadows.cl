// Which surfels see which lamps: any-hit rays through trees of triangles, one tree for each sector (a tile) that may hold one. Runs
// when a lamp or what it lights has moved.
//
// A lamp has one plane of bits, an area AREA_SHADOW_RAYS; as with the sun, bit s % 32 of word s // 32 says whether surfel s sees it.
// Bits of surfels that a lamp doesn't shine at are 0.
//
// Global size: (words, rays' planes), one work-item per word. Surfels of a word are neighbours (a brick lies in one 4 m cell) and
// their rays meet in the lamp, so 32 of them walk a tree together, eight at a time:
//
//     lamp *--___            +----+  a node outside of the box about the rays: skipped, with all below it
//          \     ---___      |    |
//           \    box   --___ +----+  a node inside: skipped where each ray passes beside it
//            s s s s s s s s
//
// Rays run from the lamp: `target + t way`, t in 0..1. With one start for all, what is left per ray of Moller and Trumbore's test is
// three scalar products with vectors of the triangle and the lamp alone.
#include "layout.h"
#include "lights.h"

// Rays that meet an edge exactly must not slip between the two triangles that share it.
#define EDGE_SLACK 1e-5f
#define DEGENERATE 1e-12f
// One instruction each, where fmin and fmax are three for the sake of NaN, of which there is none.
#define LESSER(a, b) ((a) < (b) ? (a) : (b))
#define LARGER(a, b) ((a) > (b) ? (a) : (b))
// Ways this short along an axis stand for parallel to it; what divides by them stays finite.
#define SHORTEST_WAY 1e-25f

// Rays of LANES surfels from a lamp. open: -1 where a ray still counts; ends: the t at which it leaves the lamp.
typedef struct {
    float8 way_x, way_y, way_z;
    float8 inverse_x, inverse_y, inverse_z;
    float8 ends;
    int8 open;
} Rays;

inline float8 inverse_of(float8 way)
{
    return 1.0f / select(way, (float8)(SHORTEST_WAY), fabs(way) < SHORTEST_WAY);
}

// Whether any ray meets a box, given as corners relative to the lamp. No comparison holds for NaN.
inline int meets(const Rays *rays, float3 low, float3 high)
{
    const float8 x0 = low.x * rays->inverse_x, x1 = high.x * rays->inverse_x;
    const float8 y0 = low.y * rays->inverse_y, y1 = high.y * rays->inverse_y;
    const float8 z0 = low.z * rays->inverse_z, z1 = high.z * rays->inverse_z;
    const float8 enters = LARGER(LARGER(LESSER(x0, x1), LESSER(y0, y1)), LARGER(LESSER(z0, z1), (float8)(0.0f)));
    const float8 leaves = LESSER(LESSER(LARGER(x0, x1), LARGER(y0, y1)), LESSER(LARGER(z0, z1), (float8)(1.0f)));
    return some_of((enters <= leaves) & rays->open);
}

// Which rays a triangle blocks, -1 where it does. Moller and Trumbore, "Fast, minimum storage ray/triangle intersection", 1997. Both
// sides block; a degenerate triangle blocks nothing.
inline int8 blocks(const Rays *rays, float3 from_corner, float3 edge_a, float3 edge_b)
{
    const float3 n = cross(edge_b, edge_a), for_u = cross(edge_b, from_corner), for_v = cross(from_corner, edge_a);
    const float8 determinant = rays->way_x * n.x + rays->way_y * n.y + rays->way_z * n.z;
    const float8 size = fabs(determinant);
    const float8 sign = copysign((float8)(1.0f), determinant);
    const float8 u = sign * (rays->way_x * for_u.x + rays->way_y * for_u.y + rays->way_z * for_u.z);
    const float8 v = sign * (rays->way_x * for_v.x + rays->way_y * for_v.y + rays->way_z * for_v.z);
    const float8 t = sign * dot(edge_b, for_v);
    const float8 slack = size * EDGE_SLACK;
    return (size >= DEGENERATE) & (u >= -slack) & (v >= -slack) & (u + v <= size + slack) & (t >= rays->ends * size) & (t <= size);
}

inline void walk(Rays *rays, uint groups, float3 least, float3 most, float3 lamp, __global const ShadowNode *nodes, uint end,
                 __global const ShadowTriangle *triangles)
{
    for (uint i = 0; i < end;) {
        const float3 low = LOAD3(nodes[i].low) - lamp, high = LOAD3(nodes[i].high) - lamp;
        uint met = 0;
        if (!any(isgreater(low, most)) && !any(isless(high, least)))
            for (uint g = 0; g < GROUPS; ++g)
                met |= (groups >> g & 1) && meets(rays + g, low, high) ? 1u << g : 0;
        if (!met) {
            i = nodes[i].skip;
            continue;
        }
        const uint leaf = nodes[i].leaf;
        for (uint t = leaf >> 3; t < (leaf >> 3) + (leaf & 7); ++t) {
            const float3 from_corner = lamp - LOAD3(triangles[t].corner);
            const float3 edge_a = LOAD3(triangles[t].edge_a), edge_b = LOAD3(triangles[t].edge_b);
            for (uint g = 0; g < GROUPS; ++g)
                if (met >> g & 1) {
                    rays[g].open &= ~blocks(rays + g, from_corner, edge_a, edge_b);
                    if (!some_of(rays[g].open))
                        groups &= ~(1u << g);
                }
            if (!groups)
                return;
            met &= groups;
        }
        ++i;
    }
}

__kernel void trace_shadows(
    const uint words,
    __global const SurfelWord *surfels,
    __constant LocalLight *lights,
    __global const uint *planes, // light * AREA_SHADOW_RAYS + ray
    __global const uint *tile_starts,
    __global const ShadowTile *tiles,
    __global const ShadowNode *nodes,
    __global const ShadowTriangle *triangles,
    const uint again, // rays that other tiles have blocked stay blocked
    __global uint *open)
{
    const uint word = get_global_id(0);
    if (word >= words)
        return;
    const uint index = planes[get_global_id(1)] / AREA_SHADOW_RAYS, ray = planes[get_global_id(1)] % AREA_SHADOW_RAYS;
    __constant LocalLight *light = lights + index;
    __global const SurfelWord *here = surfels + word;
    __global uint *result = open + (light->first_plane + ray) * words + word;
    if (!near_word(here, LOAD3(light->position), light->range)) {
        *result = 0;
        return;
    }
    const uint before = again ? *result : 0xffffffff;
    if (!before)
        return;
    const float3 target = light_sample(light, ray);
    Rays rays[GROUPS];
    float3 least = 0.0f, most = 0.0f;
    uint groups = 0, unhidden = 0;
    for (uint g = 0; g < GROUPS; ++g) {
        const Surfels s = load_surfels(here, g);
        const int8 reached = reaches(light, &s, target) & lanes_of(before >> (LANES * g));
        Rays *r = rays + g;
        r->way_x = s.x + s.normal_x * SHADOW_START_M - target.x;
        r->way_y = s.y + s.normal_y * SHADOW_START_M - target.y;
        r->way_z = s.z + s.normal_z * SHADOW_START_M - target.z;
        const float8 length = sqrt(r->way_x * r->way_x + r->way_y * r->way_y + r->way_z * r->way_z);
        // As close to the lamp as this there is nothing in between.
        r->open = reached & (length > SHADOW_END_M);
        unhidden |= bits_of(reached & ~r->open) << (LANES * g);
        if (!some_of(r->open))
            continue;
        groups |= 1u << g;
        r->ends = SHADOW_END_M / length;
        r->inverse_x = inverse_of(r->way_x);
        r->inverse_y = inverse_of(r->way_y);
        r->inverse_z = inverse_of(r->way_z);
        least = fmin(least, (float3)(least_of(r->way_x, r->open), least_of(r->way_y, r->open), least_of(r->way_z, r->open)));
        most = fmax(most, (float3)(most_of(r->way_x, r->open), most_of(r->way_y, r->open), most_of(r->way_z, r->open)));
    }
    for (uint i = tile_starts[index]; i < tile_starts[index + 1] && groups; ++i) {
        __global const ShadowTile *tile = tiles + i;
        walk(rays, groups, least, most, target + LOAD3(tile->offset), nodes + tile->first_node, tile->end_node - tile->first_node,
             triangles + tile->first_triangle);
        for (uint g = 0; g < GROUPS; ++g)
            if ((groups >> g & 1) && !some_of(rays[g].open))
                groups &= ~(1u << g);
    }
    for (uint g = 0; g < GROUPS; ++g)
        if (groups >> g & 1)
            unhidden |= bits_of(rays[g].open) << (LANES * g);
    *result = unhidden;
}
