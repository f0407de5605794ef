// The ambient cube: irradiance along +X -X +Y -Y +Z -Z. Twin: gi_core/ambient_cube.py.
// Mitchell, McTaggart and Green, "Shading in Valve's Source Engine", 2006.
#ifndef AMBIENT_CUBE_H
#define AMBIENT_CUBE_H

// Irradiance [lx] on a surface with unit normal (nx, ny, nz). cube: 6 faces of 3 channels.
// The squares of the components sum to one, so the result lies between the smallest and the largest face.
inline float3 evaluate_cube(__global const float *cube, float nx, float ny, float nz)
{
    __global const float *x = cube + (nx >= 0.0f ? 0 : 3);
    __global const float *y = cube + (ny >= 0.0f ? 6 : 9);
    __global const float *z = cube + (nz >= 0.0f ? 12 : 15);
    const float wx = nx * nx, wy = ny * ny, wz = nz * nz;
    return (float3)(wx * x[0] + wy * y[0] + wz * z[0], wx * x[1] + wy * y[1] + wz * z[1], wx * x[2] + wy * y[2] + wz * z[2]);
}

#endif
