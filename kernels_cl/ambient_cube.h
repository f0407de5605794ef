// The ambient cube: irradiance along +X -X +Y -Y +Z -Z. Twin: gi_core/ambient_cube.py.
// Mitchell, McTaggart and Green, "Shading in Valve's Source Engine", 2006.
#ifndef AMBIENT_CUBE_H
#define AMBIENT_CUBE_H

#define CUBE_FACES 6

// Irradiance [lx] on a surface with unit normal (n.x, n.y, n.z). cube: 6 faces, each red, green, blue and 0.
// The squares of the components sum to one, so the result lies between the smallest and the largest face.
inline float4 evaluate_cube(__global const float4 *cube, float4 n)
{
    return n.x * n.x * cube[n.x >= 0.0f ? 0 : 1] + n.y * n.y * cube[n.y >= 0.0f ? 2 : 3] + n.z * n.z * cube[n.z >= 0.0f ? 4 : 5];
}

#endif
