// Forgets samples of the sun's shadow map that are too old: baked visibility takes over. Runs when the sun has left a map behind.
//
//   sun_sample[s] = sampled_in[s] < oldest ? NO_SAMPLE : as it was
//
// Eight surfels at a time, as in sample_shadow_map.cl. Global size: groups of eight surfels.
#include "layout.h"
#include "vectors.h"

__kernel void forget_sun_samples(const uint groups, const uint oldest, __global const ushort8 *sampled_in, __global uchar8 *sun_sample)
{
    const uint group = get_global_id(0);
    if (group >= groups)
        return;
    const int8 is_old = TO_INTS(sampled_in[group]) < (int)oldest;
    sun_sample[group] = TO_UCHARS(is_old ? (int8)(NO_SAMPLE) : TO_INTS(sun_sample[group]));
}
