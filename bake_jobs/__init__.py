"""Batch bake: sources, placement, rays, surfels, factors, voxels; the path tracer and what is measured with it."""
