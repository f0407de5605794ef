// Probes' light in a poorer basis than the bake's, before a volume is filled with it: a probe has some ten numbers, a volume thousands of
// voxels. A cube is the irradiance along its axes, which harmonics may put below zero where there is none: not here.
//
//   converted[b] = sum over coefficients i: matrix[b][i] * light[i]      [lx]      (of linear harmonics, and what ZH3 adds to them)
//
// One work-item per converted coefficient of a probe. Twin: gi_core/basis.py, convert.
//
// Defines: FROM_SIZE, TO_SIZE, coefficients of either.
#ifndef FROM_SIZE
#error "FROM_SIZE is not defined"
#endif
#ifndef TO_SIZE
#error "TO_SIZE is not defined"
#endif

#if FROM_SIZE == 4
// The zonal second band that is to be expected of linear harmonics, along an axis. Roughton et al., "ZH3", I3D 2024.
inline float4 zh3_band(__global const float4 *light, float nx, float ny, float nz)
{
    const float4 mean = light[0] * M_1_PI_F;
    const float per_gradient = 3.0f / (2.0f * M_PI_F);
    const float4 gx = light[3] * per_gradient, gy = light[1] * per_gradient, gz = light[2] * per_gradient;
    const float ax = 0.2126f * gx.x + 0.7152f * gx.y + 0.0722f * gx.z;
    const float ay = 0.2126f * gy.x + 0.7152f * gy.y + 0.0722f * gy.z;
    const float az = 0.2126f * gz.x + 0.7152f * gz.y + 0.0722f * gz.z;
    const float length = sqrt(ax * ax + ay * ay + az * az);
    const float scale = 1.0f / (length > 1e-30f ? length : 1e-30f);
    const float4 along = (gx * ax + gy * ay + gz * az) * scale;
    const float4 ratio = fmin(fabs(along) / fmax(mean, 1e-30f), 1.7320508f); // a single direction
    const float4 zonal = mean * (0.08f * ratio + 0.6f * ratio * ratio);
    const float cosine = (nx * ax + ny * ay + nz * az) * scale;
    return zonal * (0.25f * M_PI_F * 0.31539157f * (3.0f * cosine * cosine - 1.0f));
}
#endif

__kernel void convert_probes(
    const uint rows,
    __global const float4 *light,
    __constant const float *matrix,
    __global float4 *converted)
{
    const uint row = get_global_id(0);
    if (row >= rows)
        return;
    const uint probe = row / TO_SIZE, b = row % TO_SIZE;
    __global const float4 *own = light + probe * FROM_SIZE;
    float4 sum = 0.0f;
    for (uint i = 0; i < FROM_SIZE; ++i)
        sum += matrix[b * FROM_SIZE + i] * own[i];
#if FROM_SIZE == 4
    const float towards = b & 1 ? -1.0f : 1.0f;
    const uint axis = b / 2;
    sum += zh3_band(own, axis == 0 ? towards : 0.0f, axis == 1 ? towards : 0.0f, axis == 2 ? towards : 0.0f);
#endif
#if TO_SIZE == 6
    sum = sum > 0.0f ? sum : 0.0f;
#endif
    converted[row] = (float4)(sum.x, sum.y, sum.z, 0.0f);
}
