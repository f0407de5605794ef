// The ambient cube: irradiance along +X -X +Y -Y +Z -Z. On a surface with unit normal n it is the sum over the three axes of n_axis^2
// times the face on n's side: the squares sum to one, so the result lies between the smallest and the largest face.
// Mitchell, McTaggart and Green, "Shading in Valve's Source Engine", 2006. Twin: gi_core/ambient_cube.py.
#ifndef AMBIENT_CUBE_H
#define AMBIENT_CUBE_H

#define CUBE_FACES 6

#endif
