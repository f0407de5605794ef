// Pass 2 of a relight (slide "Relight probes": lighting from the sky, sum up brick and sky irradiance).
//
//   probe coefficient b = sum over the probe's factors: weight[factor][b] * exitance[factor_source[factor]]    [lx]
//
// Sources are bricks, then sky patches, so one loop sums both. Writes all of probe_cube. One work-item per probe; sums run in the
// order of the factor list, every other factor in a sum of its own, so that an addition need not wait for the one before it: the same
// input gives the same bits.
//
// The sums are kept by channel: a weight vector times a scalar is one instruction for eight coefficients, where a colour times a scalar
// is one for three. Weights are read as they are stored (gi_core/factor_weights.py), a byte each: the root, of harmonics the root and its
// sign plus 128, since PoCL turns signed bytes into floats one by one. Floats would be four times as much to read. Bricks and sky have
// scales of their own, by which their sums are multiplied.
// Codes lie as tightly as they can: a vector's last components are then the next factor's first, whose sums nobody reads, and behind the
// last factor lies padding. A ninth coefficient would need a whole vector more for each channel, so it is kept apart, as a colour.
//
// Defines: BASIS_SIZE, coefficients per channel: 4, 6 (the ambient cube, whose codes have no sign) or 9.
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif
#include "layout.h"
#if BASIS_SIZE == 4
#define PER_SQUARE (float4)(SQUARE_0, SQUARE_1, SQUARE_2, SQUARE_3)
#elif BASIS_SIZE == 9
#define PER_SQUARE (float8)(SQUARE_0, SQUARE_1, SQUARE_2, SQUARE_3, SQUARE_4, SQUARE_5, SQUARE_6, SQUARE_7)
#endif

#if BASIS_SIZE == 4
typedef float4 weights_t;
typedef uchar4 codes_t;
#define ROOTS(codes) (convert_float4(codes) - 128.0f)
#define MAGNITUDES(roots) as_float4(as_uint4(roots) & 0x7fffffffu)
#elif BASIS_SIZE == 6
typedef float8 weights_t;
typedef uchar8 codes_t;
#define ROOTS(codes) convert_float8(codes)
#define MAGNITUDES(roots) roots
#else
typedef float8 weights_t;
typedef uchar8 codes_t;
#define ROOTS(codes) (convert_float8(codes) - 128.0f)
#define MAGNITUDES(roots) as_float8(as_uint8(roots) & 0x7fffffffu)
#endif
// A factor's codes start wherever the last one's end, and so do a probe's scales.
typedef codes_t loose_codes_t __attribute__((aligned(1)));
typedef weights_t loose_weights_t __attribute__((aligned(4)));
#define IN_VECTOR (BASIS_SIZE == 9 ? 8 : BASIS_SIZE)

#if BASIS_SIZE == 9
#define ADD_LAST(f, source, last)                                                                                 \
    {                                                                                                             \
        const float root = (float)factor_code[(f) * BASIS_SIZE + 8] - 128.0f;                                     \
        last += root * as_float(as_uint(root) & 0x7fffffffu) * *(__global const float4 *)source;                  \
    }
#else
#define ADD_LAST(f, source, last)
#endif
#define ADD_FACTOR(f, red, green, blue, last)                                                                     \
    {                                                                                                             \
        __global const float *source = (__global const float *)(exitance + factor_source[f]);                     \
        const weights_t roots = ROOTS(*(__global const loose_codes_t *)(factor_code + (f) * BASIS_SIZE));         \
        const weights_t weight = roots * MAGNITUDES(roots);                                                       \
        red += weight * source[0];                                                                                \
        green += weight * source[1];                                                                              \
        blue += weight * source[2];                                                                               \
        ADD_LAST(f, source, last)                                                                                 \
    }

inline void gather_probe(
    const uint probe,
    __global const uint *factor_starts,
    __global const uint *sky_starts,
    __global const uint *factor_source,
    __global const uchar *factor_code,
    __global const float *factor_scale,
    __global const float4 *exitance,
    __global float4 *probe_cube)
{
    weights_t all_red = 0.0f, all_green = 0.0f, all_blue = 0.0f;
#if BASIS_SIZE == 9
    float4 all_last = 0.0f;
#endif
    uint f = factor_starts[probe];
    for (uint kind = 0; kind < 2; ++kind) { // bricks, then sky patches
        weights_t red = 0.0f, green = 0.0f, blue = 0.0f, odd_red = 0.0f, odd_green = 0.0f, odd_blue = 0.0f;
#if BASIS_SIZE == 9
        float4 last = 0.0f, odd_last = 0.0f;
#endif
        const uint end = kind == 0 ? sky_starts[probe] : factor_starts[probe + 1];
        for (; f + 1 < end; f += 2) {
            ADD_FACTOR(f, red, green, blue, last)
            ADD_FACTOR(f + 1, odd_red, odd_green, odd_blue, odd_last)
        }
        if (f < end) {
            ADD_FACTOR(f, red, green, blue, last)
            ++f;
        }
        __global const float *scales = factor_scale + (2 * probe + kind) * BASIS_SIZE;
        weights_t scale = *(__global const loose_weights_t *)scales;
        red += odd_red;
        green += odd_green;
        blue += odd_blue;
#if BASIS_SIZE == 6
        all_red += scale * red;
        all_green += scale * green;
        all_blue += scale * blue;
#else
        const weights_t per_square = scales[0] * PER_SQUARE;
        scale.s0 = 0.0f; // the others are trims: so much more for each square of the first code
        all_red += per_square * red + scale * red.s0;
        all_green += per_square * green + scale * green.s0;
        all_blue += per_square * blue + scale * blue.s0;
#endif
#if BASIS_SIZE == 9
        all_last += scales[0] * SQUARE_8 * (last + odd_last) + scales[8] * (float4)(red.s0, green.s0, blue.s0, 0.0f);
#endif
    }
    // Private arrays of floats: the one way to index a vector by a variable.
    const float *r = (const float *)&all_red, *g = (const float *)&all_green, *b = (const float *)&all_blue;
    __attribute__((opencl_unroll_hint(IN_VECTOR)))
    for (int i = 0; i < IN_VECTOR; ++i)
        probe_cube[probe * BASIS_SIZE + i] = (float4)(r[i], g[i], b[i], 0.0f);
#if BASIS_SIZE == 9
    all_last.w = 0.0f;
    probe_cube[probe * BASIS_SIZE + 8] = all_last;
#endif
}

__kernel void gather_probes(
    const uint probes,
    __global const uint *factor_starts,
    __global const uint *sky_starts,
    __global const uint *factor_source,
    __global const uchar *factor_code,
    __global const float *factor_scale,
    __global const float4 *exitance,
    __global float4 *probe_cube)
{
    const uint probe = get_global_id(0);
    if (probe < probes)
        gather_probe(probe, factor_starts, sky_starts, factor_source, factor_code, factor_scale, exitance, probe_cube);
}
