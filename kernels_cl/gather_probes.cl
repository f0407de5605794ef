// Pass 2 of a relight (slide "Relight probes": lighting from the sky, sum up brick and sky irradiance).
//
//   probe coefficient b = sum over the probe's factors: factor_weight[factor][b] * exitance[factor_source[factor]]    [lx]
//
// Sources are bricks, then sky patches, so one loop sums both. Writes all of probe_cube. One work-item per probe; sums run in the
// order of the factor list: the same input gives the same bits.
//
// A factor's weights are padded to whole float4, and the sums are kept by channel: a weight vector times a scalar is one instruction
// for eight coefficients, where a colour times a scalar is one for three.
//
// Defines: BASIS_SIZE, coefficients per channel (6: the ambient cube); WEIGHT_VECTORS, how many float4 hold a factor's weights.
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif
#ifndef WEIGHT_VECTORS
#error "WEIGHT_VECTORS is not defined"
#endif

#if WEIGHT_VECTORS == 2
typedef float8 weights_t;
#define SUMS 1
#else
typedef float4 weights_t;
#define SUMS WEIGHT_VECTORS
#endif

__kernel void gather_probes(
    const uint probes,
    __global const uint *factor_starts,
    __global const uint *factor_source,
    __global const weights_t *factor_weight,
    __global const float4 *exitance,
    __global float4 *probe_cube)
{
    const uint probe = get_global_id(0);
    if (probe >= probes)
        return;
    weights_t red[SUMS], green[SUMS], blue[SUMS];
    __attribute__((opencl_unroll_hint(SUMS)))
    for (int v = 0; v < SUMS; ++v)
        red[v] = green[v] = blue[v] = (weights_t)(0.0f);
    const uint end = factor_starts[probe + 1];
    for (uint f = factor_starts[probe]; f < end; ++f) {
        __global const float *source = (__global const float *)(exitance + factor_source[f]);
        __attribute__((opencl_unroll_hint(SUMS)))
        for (int v = 0; v < SUMS; ++v) {
            const weights_t weight = factor_weight[f * SUMS + v];
            red[v] += weight * source[0];
            green[v] += weight * source[1];
            blue[v] += weight * source[2];
        }
    }
    // Private arrays of floats: the one way to index a vector by a variable.
    const float *r = (const float *)red, *g = (const float *)green, *b = (const float *)blue;
    __attribute__((opencl_unroll_hint(BASIS_SIZE)))
    for (int i = 0; i < BASIS_SIZE; ++i)
        probe_cube[probe * BASIS_SIZE + i] = (float4)(r[i], g[i], b[i], 0.0f);
}
