"""Dataset formats, sun, sky and weather, the relighter and its twin, volumes. Knows kernels_cl; no mesh or HTTP library."""
