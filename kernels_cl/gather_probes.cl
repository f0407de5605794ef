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
// are then the next factor's first, whose sums nobody reads, and behind the last factor lies padding.
//
// Defines: BASIS_SIZE, coefficients per channel (6: the ambient cube); WEIGHT_VECTORS, how many float4 a factor's weights touch.
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif
#ifndef WEIGHT_VECTORS
#error "WEIGHT_VECTORS is not defined"
#endif

// A factor's weights start wherever the last one's end.
#if WEIGHT_VECTORS == 2
typedef float8 weights_t;
#define SUMS 1
#define COMPONENTS 8
#else
typedef float4 weights_t;
#define SUMS WEIGHT_VECTORS
#define COMPONENTS 4
#endif
typedef weights_t loose_weights_t __attribute__((aligned(4)));

#define ADD_FACTOR(f, red, green, blue)                                                                   \
    {                                                                                                     \
        __global const float *source = (__global const float *)(exitance + factor_source[f]);             \
        __attribute__((opencl_unroll_hint(SUMS)))                                                         \
        for (int v = 0; v < SUMS; ++v) {                                                                  \
            const weights_t weight =                                                                      \
                *(__global const loose_weights_t *)(factor_weight + (f) * BASIS_SIZE + v * COMPONENTS);   \
            red[v] += weight * source[0];                                                                 \
            green[v] += weight * source[1];                                                               \
            blue[v] += weight * source[2];                                                                \
        }                                                                                                 \
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
    weights_t red[SUMS], green[SUMS], blue[SUMS], odd_red[SUMS], odd_green[SUMS], odd_blue[SUMS];
    __attribute__((opencl_unroll_hint(SUMS)))
    for (int v = 0; v < SUMS; ++v)
        red[v] = green[v] = blue[v] = odd_red[v] = odd_green[v] = odd_blue[v] = (weights_t)(0.0f);
    const uint end = factor_starts[probe + 1];
    uint f = factor_starts[probe];
    for (; f + 1 < end; f += 2) {
        ADD_FACTOR(f, red, green, blue)
        ADD_FACTOR(f + 1, odd_red, odd_green, odd_blue)
    }
    if (f < end)
        ADD_FACTOR(f, red, green, blue)
    __attribute__((opencl_unroll_hint(SUMS)))
    for (int v = 0; v < SUMS; ++v) {
        red[v] += odd_red[v];
        green[v] += odd_green[v];
        blue[v] += odd_blue[v];
    }
    // Private arrays of floats: the one way to index a vector by a variable.
    const float *r = (const float *)red, *g = (const float *)green, *b = (const float *)blue;
    __attribute__((opencl_unroll_hint(BASIS_SIZE)))
    for (int i = 0; i < BASIS_SIZE; ++i)
        probe_cube[probe * BASIS_SIZE + i] = (float4)(r[i], g[i], b[i], 0.0f);
}
