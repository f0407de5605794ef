// Once for a sector of harmonics, when it comes to the device: a factor's four codes, as files have them, become one of each harmonic, as
// gather_probes.cl reads them. Twin: gi_core/factor_weights.py, expanded.
//
//   code[0] = first + 128      code[b] = first * root[direction][b - 1] / 127 + 128, to the nearest whole number
//
// The codes of a direction (y, z, x) are whole steps, FACE_STEPS of them at most either way, and root_of_direction has a row for each of
// the cube of all. Its signed roots of 127 have 128 added, since PoCL turns signed bytes into other numbers one by one; so all of this
// stays above 0, and is whole numbers. There are no ties: 127 is a prime above all factors of the product but 127 itself.
//
// All first codes come before all of y, these before those of z and of x. One work-item per factor. Defines: BASIS_SIZE, coefficients per channel: 4 or 9; FACE_STEPS.
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif
#ifndef FACE_STEPS
#error "FACE_STEPS is not defined"
#endif
#define EDGE (2 * FACE_STEPS + 1)

__kernel void expand_factors(
    const uint factors,
    __global const char *factor,
    __global const uchar8 *root_of_direction,
    __global uchar *factor_code)
{
    const uint f = get_global_id(0);
    if (f >= factors)
        return;
    const uint first = factor[f];
    const int y = factor[factors + f], z = factor[2 * factors + f], x = factor[3 * factors + f];
    const uint direction = ((y + FACE_STEPS) * EDGE + z + FACE_STEPS) * EDGE + x + FACE_STEPS;
    // 127 * 128 for the result's 128, 63 to round, and what the roots have too much.
    const uint8 code = (convert_uint8(root_of_direction[direction]) * first + (127 * 128 + 63 - 128 * first)) / 127;
    __global uchar *to = factor_code + f * BASIS_SIZE;
    to[0] = first + 128;
#if BASIS_SIZE == 9
    vstore8(convert_uchar8(code), 0, to + 1);
#else
    to[1] = code.s0;
    to[2] = code.s1;
    to[3] = code.s2;
#endif
}
