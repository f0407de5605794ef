// Snow on a surfel (slide "Procedural snow"). Twin: gi_core/relight_twin.py, snowed_albedo.
#ifndef SNOW_H
#define SNOW_H

#include "layout.h"

// Albedo blended to white; cover: 0..1. Never above what is larger of the two, so the bounces stay a contraction.
inline float4 snowed_albedo(float4 albedo, float cover)
{
    return albedo + (SNOW_ALBEDO - albedo) * cover;
}

#endif
