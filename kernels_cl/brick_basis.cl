// Once for a sector of harmonics, when it comes to the device: what each coefficient of a probe's light adds to a bounce off a brick, the
// mean over its surfels of what it adds along their normals. Twin: gi_core/relight_twin.py, brick_basis, which sums in another order.
//
// Reads surfel_normal, x, y and z one after the other, each padded to surfel_room. Writes brick_basis[brick * BASIS_SIZE + b].
//
// One work-item per brick. Defines: BASIS_SIZE, coefficients per channel: 4 or 9.
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif

__kernel void brick_basis(
    const uint bricks,
    __global const uint *brick_starts,
    __global const float *surfel_normal,
    const uint surfel_room,
    __constant const float *norm,
    const float directional,
    __global float *basis)
{
    const uint brick = get_global_id(0);
    if (brick >= bricks)
        return;
    const uint first = brick_starts[brick], end = brick_starts[brick + 1];
    float sum[BASIS_SIZE];
    for (uint b = 0; b < BASIS_SIZE; ++b)
        sum[b] = 0.0f;
    for (uint s = first; s < end; ++s) {
        const float x = surfel_normal[s], y = surfel_normal[surfel_room + s], z = surfel_normal[2 * surfel_room + s];
        sum[0] += norm[0];
        sum[1] += y * norm[1] * directional;
        sum[2] += z * norm[2] * directional;
        sum[3] += x * norm[3] * directional;
#if BASIS_SIZE == 9
        sum[4] += x * y * norm[4];
        sum[5] += y * z * norm[5];
        sum[6] += (3.0f * z * z - 1.0f) * norm[6];
        sum[7] += x * z * norm[7];
        sum[8] += (x * x - y * y) * norm[8];
#endif
    }
    for (uint b = 0; b < BASIS_SIZE; ++b)
        basis[brick * BASIS_SIZE + b] = sum[b] / (float)(end - first);
}
