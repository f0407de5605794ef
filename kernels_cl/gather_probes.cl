// Pass 2 of a relight (slide "Relight probes": lighting from the sky, sum up brick and sky irradiance).
//
//   probe coefficient b = sum over the probe's factors: factor_weight[factor][b] * exitance[factor_source[factor]]    [lx]
//
// Sources are bricks, then sky patches, so one loop sums both. Writes all of probe_cube. One work-item per probe; sums run in the
// order of the factor list: the same input gives the same bits.
//
// Loops over the basis are unrolled by hint: PoCL 3.0 otherwise keeps `sum` in memory, which takes three times as long.
//
// Defines: BASIS_SIZE, coefficients per channel (6: the ambient cube).
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif

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
    float4 sum[BASIS_SIZE];
    __attribute__((opencl_unroll_hint(BASIS_SIZE)))
    for (int b = 0; b < BASIS_SIZE; ++b)
        sum[b] = (float4)(0.0f);
    const uint end = factor_starts[probe + 1];
    for (uint f = factor_starts[probe]; f < end; ++f) {
        const float4 source = exitance[factor_source[f]];
        __attribute__((opencl_unroll_hint(BASIS_SIZE)))
        for (int b = 0; b < BASIS_SIZE; ++b)
            sum[b] += factor_weight[f * BASIS_SIZE + b] * source;
    }
    __attribute__((opencl_unroll_hint(BASIS_SIZE)))
    for (int b = 0; b < BASIS_SIZE; ++b)
        probe_cube[probe * BASIS_SIZE + b] = sum[b];
}
