// What of a sector's light is shown: the artists' gains, and a fade from what was shown before: what stood for a sector that has just been
// loaded, or its own light before its sun's visibility had another source. Outside of the loop of bounces: nothing here is fed back. A
// sector that needs neither is shown as it is, and has no buffer for this.
//
//   shown += share * (first + bounce_factor * (all - first) + ambient of the probe's room  -  shown)     [lx]
//
// A fade of n steps has the shares 1/n, 1/(n - 1) ... 1: under a light that stays, equal steps.
// first is what one pass from darkness gives (gather_probes.cl), all the sector's own cubes. One work-item per cube face.
//
// Defines: CUBE_ROWS, coefficients per probe; HAS_BOUNCE_FACTOR 0 or 1: otherwise all is shown and first is not there.
#ifndef CUBE_ROWS
#error "CUBE_ROWS is not defined"
#endif
#ifndef HAS_BOUNCE_FACTOR
#error "HAS_BOUNCE_FACTOR is not defined"
#endif

__kernel void show_probes(
    const uint rows,
    __global const float4 *all,
#if HAS_BOUNCE_FACTOR
    __global const float4 *first,
    const float bounce_factor,
#endif
    __global const ushort *probe_room,
    __constant const float4 *ambient, // of each coefficient outdoors, then indoors
    const float share,
    __global float4 *shown)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const uint probe = row / CUBE_ROWS, b = row % CUBE_ROWS;
    const float4 before = shown[row];
#if HAS_BOUNCE_FACTOR
    float4 light = first[row] + bounce_factor * (all[row] - first[row]);
#else
    float4 light = all[row];
#endif
    light += ambient[(probe_room[probe] != 0 ? CUBE_ROWS : 0) + b];
    shown[row] = before + share * (light - before);
}
