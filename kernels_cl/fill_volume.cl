// Fills one sector's part of an irradiance volume (slide "Irradiance volume") from the probes that each voxel blends.
//
//   volume[b][y][z][x] = sum over the voxel's probes: voxel_weight * probe_cube[b]    [lx]
//
// Global size: (box x, box y, box z), one work-item per voxel of the box. Heights outside the sector's stored range read its lowest
// or highest layer: above the roofs is open air. A box that reaches past a volume's last layer goes on at its first, and past the last column
// of a layer at the layer's first: the volume of somebody who walks is rings in memory, and a step writes new voxels where old ones were.
//
// Defines: BASIS_SIZE, VOXEL_PROBES.
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif
#ifndef VOXEL_PROBES
#error "VOXEL_PROBES is not defined"
#endif

#include "layout.h"

__kernel void fill_volume(
    const VolumeBox box,
    __global const ushort *voxel_probe,
    __global const float *voxel_weight,
    __global const float4 *probe_cube,
    __global float *volume)
{
    const int x = get_global_id(0), y = get_global_id(1), z = get_global_id(2);
    if (x >= box.box_size[0] || y >= box.box_size[1] || z >= box.box_size[2])
        return;
    const int sx = box.sector_first[0] + x, sz = box.sector_first[2] + z;
    const int sy = clamp(box.sector_first[1] + y, 0, box.sector_size[1] - 1);
    const uint voxel = ((uint)sy * box.sector_size[2] + sz) * box.sector_size[0] + sx;
    float4 sum[BASIS_SIZE];
    __attribute__((opencl_unroll_hint(BASIS_SIZE)))
    for (int b = 0; b < BASIS_SIZE; ++b)
        sum[b] = (float4)(0.0f);
    for (int k = 0; k < VOXEL_PROBES; ++k) {
        const float weight = voxel_weight[voxel * VOXEL_PROBES + k];
        __global const float4 *cube = probe_cube + (uint)voxel_probe[voxel * VOXEL_PROBES + k] * BASIS_SIZE;
        __attribute__((opencl_unroll_hint(BASIS_SIZE)))
        for (int b = 0; b < BASIS_SIZE; ++b)
            sum[b] += weight * cube[b];
    }
    const uint voxels = (uint)box.volume_size[0] * box.volume_size[1] * box.volume_size[2];
    const int columns = box.volume_size[0] * box.volume_size[2];
    int column = (box.volume_first[2] + z) * box.volume_size[0] + box.volume_first[0] + x;
    column -= column >= columns ? columns : 0;
    int layer = box.volume_first[1] + y;
    layer -= layer >= box.volume_size[1] ? box.volume_size[1] : 0;
    const uint at = (uint)layer * columns + column;
    __attribute__((opencl_unroll_hint(BASIS_SIZE)))
    for (int b = 0; b < BASIS_SIZE; ++b)
    {
        // Three stores: vstore3 is a call (see sun_on_surfels.cl).
        __global float *target = volume + 3 * (b * voxels + at);
        target[0] = sum[b].x;
        target[1] = sum[b].y;
        target[2] = sum[b].z;
    }
}
