// Draws triangles into the sun's shadow map (slide "Sun shadow").
//
//   map[row][column] = the greatest depth of all triangles over the texel's centre
//
// A work-item owns every n-th row and draws all triangles into those, so no two write the same place, nothing is atomic, and the map is
// the same whatever order work-items run in. A triangle is a few spans, one for each row whose centre it covers:
//
//      o - - - - - - - -  row of texel centres above: not covered
//      |\__
//      |   \__
//     -*--*--*\_ - - - -  span: the centres between two edges
//      |        \__
//
// Depth is linear along a span. Global size: n, how many rows apart a work-item's are.
#include "layout.h"
#include "shadow_map.h"

// Twice the area [texels^2] below which a triangle is seen edge on, and covers no centre that its neighbours do not.
#define EDGE_ON 1e-6f
// A span starts at any column.
typedef float8 loose_float8 __attribute__((aligned(4)));

__kernel void draw_shadow_map(
    const ShadowFrame frame,
    const uint triangles,
    __global const ShadowTriangle *triangle,
    __global float *map)
{
    const int size = (int)frame.size, rows_apart = get_global_size(0), own = get_global_id(0);
    for (uint t = 0; t < triangles; ++t) {
        __global const float *corner = triangle[t].corner, *a = triangle[t].edge_a, *b = triangle[t].edge_b;
        const float4 p0 = map_from_sector(&frame, corner[0], corner[1], corner[2]);
        const float4 p1 = map_from_sector(&frame, corner[0] + a[0], corner[1] + a[1], corner[2] + a[2]);
        const float4 p2 = map_from_sector(&frame, corner[0] + b[0], corner[1] + b[1], corner[2] + b[2]);
        const float low = p0.y < p1.y ? (p0.y < p2.y ? p0.y : p2.y) : (p1.y < p2.y ? p1.y : p2.y);
        const float high = p0.y > p1.y ? (p0.y > p2.y ? p0.y : p2.y) : (p1.y > p2.y ? p1.y : p2.y);
        if (!(high >= 0.5f && low <= size - 0.5f))
            continue;
        const float4 u = p1 - p0, v = p2 - p0;
        const float area = u.x * v.y - v.x * u.y;
        if (!(area > EDGE_ON || area < -EDGE_ON))
            continue;
        const float depth_by_column = (u.z * v.y - v.z * u.y) / area, depth_by_row = (v.z * u.x - u.z * v.x) / area;
        // A triangle seen nearly edge on has slopes that rounding makes up: above its highest corner they would shade what it does not.
        const float highest = p0.z > p1.z ? (p0.z > p2.z ? p0.z : p2.z) : (p1.z > p2.z ? p1.z : p2.z);
        const float from = low - 0.5f > 0.0f ? low - 0.5f : 0.0f, until = high - 0.5f < size - 1 ? high - 0.5f : size - 1;
        const int row_of_low = (int)from + ((int)from < from), row_of_high = (int)until;
        const int before_own = (row_of_low - own + rows_apart - 1) / rows_apart;
        for (int row = own + before_own * rows_apart; row <= row_of_high; row += rows_apart) {
            const float y = row + 0.5f;
            float left = 1e30f, right = -1e30f;
            for (int edge = 0; edge < 3; ++edge) {
                const float4 start = edge == 0 ? p0 : edge == 1 ? p1 : p2, end = edge == 0 ? p1 : edge == 1 ? p2 : p0;
                if ((start.y <= y) == (end.y <= y))
                    continue;
                const float x = start.x + (y - start.y) * (end.x - start.x) / (end.y - start.y);
                left = x < left ? x : left;
                right = x > right ? x : right;
            }
            left = left - 0.5f > 0.0f ? left - 0.5f : 0.0f;
            right = right - 0.5f < size - 1 ? right - 0.5f : size - 1;
            if (!(left <= right))
                continue;
            const float depth_at_zero = p0.z + depth_by_row * (y - p0.y) + depth_by_column * (0.5f - p0.x);
            __global float *line = map + row * SHADOW_ROW_TEXELS;
            // Eight columns at a time; those beyond the span's end stay as they are, and rows are long enough for them to be there.
            for (int column = (int)left + ((int)left < left); column <= (int)right; column += 8) {
                __global loose_float8 *texels = (__global loose_float8 *)(line + column);
                const float8 at = (float)column + (float8)(0, 1, 2, 3, 4, 5, 6, 7), before = *texels;
                const float8 plane = depth_at_zero + depth_by_column * at, depth = plane > highest ? (float8)(highest) : plane;
                *texels = at <= right && depth > before ? depth : before;
            }
        }
    }
}
