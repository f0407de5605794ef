// Works out what each brick sends on of its feedback probes' light: surfels do not change, so neither does their mean response to a
// probe, and a pass need not look at surfels at all. Runs when a sector is loaded, and when snow has changed their albedo.
//
//   light on a surfel from its feedback probes = sum over probes: weight * sum over coefficients b: basis[b](normal) * light[b]
//
// Of the cube, which reads one face per axis, a brick's bounces are of single faces:
//
//   bounce of (brick, probe, face) = mean over the brick's surfels: snowed-on albedo * weight * n_axis^2
//
// Of harmonics a normal reads all, and a brick's surfels face about the same way: bounce_bricks.cl evaluates a probe's light once for the
// brick, along their mean basis, and a bounce is of a whole probe:
//
//   bounce of (brick, probe)       = mean over the brick's surfels: snowed-on albedo * weight
//
// Writes each brick's bounces from bounce_starts[brick] on, in the order in which its surfels first need them, and how many there are
// to bounce_count; there is room for all when the starts leave for each surfel FEEDBACK_PROBES, of the cube 3 * FEEDBACK_PROBES.
// One work-item per brick, a fixed order: the same input gives the same bits.
//
// Defines: BASIS_SIZE, 6 is the cube; FEEDBACK_PROBES >= 1; BOUNCE_ALBEDO_PERMILLE, the most that harmonics may send on; and 0 or 1:
// HAS_FEEDBACK_WEIGHTS (otherwise every surfel has one probe of weight 1), HAS_SNOW.
#ifndef BASIS_SIZE
#error "BASIS_SIZE is not defined"
#endif
#ifndef FEEDBACK_PROBES
#error "FEEDBACK_PROBES is not defined"
#endif
#ifndef HAS_FEEDBACK_WEIGHTS
#error "HAS_FEEDBACK_WEIGHTS is not defined"
#endif
#ifndef HAS_SNOW
#error "HAS_SNOW is not defined"
#endif

#include "layout.h"
#include "ambient_cube.h"
#include "snow.h"

#define IS_CUBE (BASIS_SIZE == CUBE_FACES)

// Adds to a brick's bounce of a row, which is made when it is the first; returns how many there are then.
inline uint add_bounce(__global Bounce *own, uint count, uint row, float4 sent)
{
    uint i = 0;
    while (i < count && own[i].row != row)
        ++i;
    __global float4 *bounce = (__global float4 *)(own + i);
    float4 sum = sent;
    if (i == count)
        ++count;
    else
        sum += *bounce;
    sum.w = as_float(row);
    *bounce = sum;
    return count;
}

__kernel void collect_bounces(
    const uint bricks,
    __global const uint *brick_starts,
    __global const float4 *surfel_albedo, // and the snow attribute
#if BASIS_SIZE == 6
    __global const float *normal, // x of all surfels, then y, then z
    const uint normal_stride,
#endif
    __global const ushort *feedback_probe,
#if HAS_FEEDBACK_WEIGHTS
    __global const float *feedback_weight,
#endif
    __global const uint *bounce_starts,
    __global Bounce *bounces,
    __global uint *bounce_count
#if HAS_SNOW
    , const float snow
#endif
)
{
    const uint brick = get_global_id(0);
    if (brick >= bricks)
        return;
    const uint first = brick_starts[brick], end = brick_starts[brick + 1];
    __global Bounce *own = bounces + bounce_starts[brick];
    const float share = 1.0f / (float)(end - first);
    uint count = 0;
    for (uint s = first; s < end; ++s) {
#if HAS_SNOW
        const float4 albedo = share * snowed_albedo(surfel_albedo[s], snow * surfel_albedo[s].w);
#else
        const float4 albedo = share * surfel_albedo[s];
#endif
#if !IS_CUBE
        const float4 most = share * (0.001f * BOUNCE_ALBEDO_PERMILLE);
        const float4 sent = albedo < most ? albedo : most;
#endif
        for (uint k = 0; k < FEEDBACK_PROBES; ++k) {
            const uint slot = s * FEEDBACK_PROBES + k;
#if HAS_FEEDBACK_WEIGHTS
            const float weight = feedback_weight[slot];
#else
            const float weight = 1.0f;
#endif
#if IS_CUBE
            for (int axis = 0; axis < 3; ++axis) {
                const float along = normal[axis * normal_stride + s];
                const float part = weight * along * along;
                if (part == 0.0f)
                    continue;
                const uint row = ROW_ONE + (uint)feedback_probe[slot] * CUBE_FACES + 2 * axis + (along < 0.0f);
                count = add_bounce(own, count, row, part * albedo);
            }
#else
            if (weight != 0.0f)
                count = add_bounce(own, count, ROW_ONE + (uint)feedback_probe[slot] * BASIS_SIZE, weight * sent);
#endif
        }
    }
    bounce_count[brick] = count;
}
