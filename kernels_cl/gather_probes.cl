// Pass 2 of a relight (slide "Relight probes": lighting from the sky, sum up brick and sky irradiance).
//
//   probe coefficient b = sum over the probe's factors: factor_weight[factor][b] * exitance[factor_source[factor]]    [lx]
//
// Sources are bricks, then sky patches, so one loop sums both. Writes all of probe_cube. One work-item per probe; sums run in the
// order of the factor list: the same input gives the same bits.
//
// The sums are kept by channel: a weight vector times a scalar is one instruction for eight coefficients, where a colour times a scalar
// is one for three. A ninth coefficient would need a whole vector more for each channel, so it is kept apart, as a colour.
//
// Defines: BASIS_SIZE, coefficients per channel: 4 and 6 (a factor's weights are padded to a whole vector of 4 or 8), or 9 (eight, and the
// ninth in factor_last).
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif

#if BASIS_SIZE == 4
typedef float4 weights_t;
#else
typedef float8 weights_t;
#endif
#define IN_VECTOR (BASIS_SIZE == 9 ? 8 : BASIS_SIZE)

__kernel void gather_probes(
    const uint probes,
    __global const uint *factor_starts,
    __global const uint *factor_source,
    __global const weights_t *factor_weight,
#if BASIS_SIZE == 9
    __global const float *factor_last,
#endif
    __global const float4 *exitance,
    __global float4 *probe_cube)
{
    const uint probe = get_global_id(0);
    if (probe >= probes)
        return;
    weights_t red = 0.0f, green = 0.0f, blue = 0.0f;
#if BASIS_SIZE == 9
    float4 last = 0.0f;
#endif
    const uint end = factor_starts[probe + 1];
    for (uint f = factor_starts[probe]; f < end; ++f) {
        const float4 source = exitance[factor_source[f]];
        const weights_t weight = factor_weight[f];
        red += weight * source.x;
        green += weight * source.y;
        blue += weight * source.z;
#if BASIS_SIZE == 9
        last += factor_last[f] * source;
#endif
    }
    // Private arrays of floats: the one way to index a vector by a variable.
    const float *r = (const float *)&red, *g = (const float *)&green, *b = (const float *)&blue;
    __attribute__((opencl_unroll_hint(IN_VECTOR)))
    for (int i = 0; i < IN_VECTOR; ++i)
        probe_cube[probe * BASIS_SIZE + i] = (float4)(r[i], g[i], b[i], 0.0f);
#if BASIS_SIZE == 9
    last.w = 0.0f;
    probe_cube[probe * BASIS_SIZE + 8] = last;
#endif
}
