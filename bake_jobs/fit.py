"""Weights of probes fitted to light: many small least squares problems over the simplex at once.

For each voxel, with A the light of its candidates and b its own, rows divided by b so that errors are relative,

    minimise  |A w - b|^2 + ridge |w - prior|^2,     w >= 0,  sum w = 1

The prior is inverse distance, which decides where the light does not. Each step moves weight from the candidate whose slope is steepest up
to the one whose slope is steepest down, as far as that helps: the sum stays 1, and most problems are solved in a few dozen steps (the
working-set choice of Platt, "Sequential Minimal Optimization", 1998). The number of steps is fixed, and each problem goes its own way.
"""

import numpy as np

from gi_core.arrays import Bool, Float32, Float64

STEPS = 120
# Smaller weights cost a probe for nothing: about half of what a weight is stored to.
LEAST_WEIGHT = 2e-3


def fit_weights(candidates: Float32, target: Float32, prior: Float32, ridge: float, most: int) -> Float32:
    """Weights (n, c) of at most ``most`` candidates each; rows are >= 0 and sum to 1.

    candidates : (n, c, r) light of each voxel's candidates; target : (n, r), its own; both divided by what they are to be relative to
    prior : (n, c), >= 0, rows sum to 1; 0 where there is no candidate, which gets no weight
    """
    rows = target.shape[1]
    gram = np.matmul(candidates, candidates.transpose(0, 2, 1)).astype(np.float64)
    right = np.matmul(candidates, target[:, :, None])[:, :, 0].astype(np.float64) + ridge * rows * prior
    diagonal = np.arange(gram.shape[1])
    gram[:, diagonal, diagonal] += ridge * rows
    weight = _descend(gram, right, prior.astype(np.float64), prior > 0)
    if candidates.shape[1] > most:
        rank = np.argsort(np.argsort(-weight, axis=1, kind="stable"), axis=1, kind="stable")
        weight = _descend(gram, right, np.where(rank < most, weight, 0), (prior > 0) & (rank < most))
    weight[weight < LEAST_WEIGHT] = 0
    return np.asarray(weight / weight.sum(axis=1, keepdims=True), np.float32)


def _descend(gram: Float64, right: Float64, start: Float64, allowed: Bool) -> Float64:
    """Minimise w . gram w / 2 - right . w over the simplex of the allowed, from a start (n, c) that is scaled to be on it."""
    weight = start / start.sum(axis=1, keepdims=True)
    slope = np.matmul(gram, weight[:, :, None])[:, :, 0] - right
    # Flat, since ``take`` from rows is twice as fast as two indices, and views, so that what is written to one is in both.
    rows, weight_flat, slope_flat = gram.reshape(-1, gram.shape[1]), weight.reshape(-1), slope.reshape(-1)
    first = np.arange(len(weight)) * gram.shape[1]
    barred = np.where(allowed, 0, np.inf)
    for _ in range(STEPS):
        to = first + np.argmin(slope + barred, axis=1)
        source = first + np.argmax(np.where(weight > 0, slope, -np.inf), axis=1)
        difference = rows.take(to, axis=0)
        difference -= rows.take(source, axis=0)
        curvature = np.maximum(difference.reshape(-1).take(to) - difference.reshape(-1).take(source), 1e-12)
        step = np.clip((slope_flat.take(source) - slope_flat.take(to)) / curvature, 0, weight_flat.take(source))
        weight_flat[to] += step
        weight_flat[source] -= step
        difference *= step[:, None]
        slope += difference
    return weight
