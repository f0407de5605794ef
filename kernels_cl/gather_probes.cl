// Pass 2 of a relight (slide "Relight probes": lighting from the sky, sum up brick and sky irradiance).
//
//   probe coefficient b = sum over the probe's factors: factor_weight[factor][b] * exitance[factor_source[factor]]    [lx]
//
// Sources are bricks, then sky patches, so one loop sums both. Writes all of probe_cube. One work-item per probe; sums run in the
// order of the factor list, every other factor in a sum of its own, so that an addition need not wait for the one before it: the same
// input gives the same bits.
//
// The sums are kept by channel: a weight vector times a scalar is one instruction for eight coefficients, where a colour times a scalar
// is one for three. Weights lie as tightly as they can, since reading them is most of what this pass does: a vector's last components
// are then the next factor's first, whose sums nobody reads, and behind the last factor lies padding. A ninth coefficient would need a
// whole vector more for each channel, so it is kept apart, as a colour.
//
// Defines: BASIS_SIZE, coefficients per channel: 4, 6 (the ambient cube) or 9.
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif

#if BASIS_SIZE == 4
typedef float4 weights_t;
#else
typedef float8 weights_t;
#endif
// A factor's weights start wherever the last one's end.
typedef weights_t loose_weights_t __attribute__((aligned(4)));
#define IN_VECTOR (BASIS_SIZE == 9 ? 8 : BASIS_SIZE)

#if BASIS_SIZE == 9
#define ADD_LAST(f, source, last) last += factor_weight[(f) * BASIS_SIZE + 8] * *(__global const float4 *)source;
#else
#define ADD_LAST(f, source, last)
#endif
#define ADD_FACTOR(f, red, green, blue, last)                                                                     \
    {                                                                                                             \
        __global const float *source = (__global const float *)(exitance + factor_source[f]);                     \
        const weights_t weight = *(__global const loose_weights_t *)(factor_weight + (f) * BASIS_SIZE);           \
        red += weight * source[0];                                                                                \
        green += weight * source[1];                                                                              \
        blue += weight * source[2];                                                                               \
        ADD_LAST(f, source, last)                                                                                 \
    }

__kernel void gather_probes(
    const uint probes,
    __global const uint *factor_starts,
    __global const uint *factor_source,
    __global const float *factor_weight,
    __global const float4 *exitance,
    __global float4 *probe_cube)
{
    const uint probe = get_global_id(0);
    if (probe >= probes)
        return;
    weights_t red = 0.0f, green = 0.0f, blue = 0.0f, odd_red = 0.0f, odd_green = 0.0f, odd_blue = 0.0f;
#if BASIS_SIZE == 9
    float4 last = 0.0f, odd_last = 0.0f;
#endif
    const uint end = factor_starts[probe + 1];
    uint f = factor_starts[probe];
    for (; f + 1 < end; f += 2) {
        ADD_FACTOR(f, red, green, blue, last)
        ADD_FACTOR(f + 1, odd_red, odd_green, odd_blue, odd_last)
    }
    if (f < end)
        ADD_FACTOR(f, red, green, blue, last)
    red += odd_red;
    green += odd_green;
    blue += odd_blue;
    // Private arrays of floats: the one way to index a vector by a variable.
    const float *r = (const float *)&red, *g = (const float *)&green, *b = (const float *)&blue;
    __attribute__((opencl_unroll_hint(IN_VECTOR)))
    for (int i = 0; i < IN_VECTOR; ++i)
        probe_cube[probe * BASIS_SIZE + i] = (float4)(r[i], g[i], b[i], 0.0f);
#if BASIS_SIZE == 9
    last += odd_last;
    last.w = 0.0f;
    probe_cube[probe * BASIS_SIZE + 8] = last;
#endif
}
