"""Weights of probes fitted to light: many small non-negative least squares at once.

For each voxel, with A the light of its candidates and b its own, rows divided by b so that errors are relative,

    minimise  |A w - b|^2 + ridge |w - prior|^2,     w >= 0,  sum w = 1

The prior is inverse distance, which decides where the states do not. Sweeps of coordinate descent over the normal equations: a fixed
number, in a fixed order, so that the result does not depend on what else is fitted beside it. The sum is held by a row of its own and
made exact at the end.
"""

import numpy as np

from gi_core.arrays import Bool, Float32, Float64

SWEEPS = 60
# What the row that holds the sum weighs beside a row of light. More holds it better, and slows the sweeps.
SUM_WEIGHT = 2.0


def fit_weights(candidates: Float32, target: Float32, prior: Float32, ridge: float, most: int) -> Float32:
    """Weights (n, c) of at most ``most`` candidates each; rows are >= 0 and sum to 1.

    candidates : (n, c, r) light of each voxel's candidates; target : (n, r), its own; both divided by what they are to be relative to
    prior : (n, c), >= 0, rows sum to 1; 0 where there is no candidate, which gets no weight
    """
    there = prior > 0
    weight = _descend(candidates, target, prior, ridge, there)
    if candidates.shape[1] > most:
        rank = np.argsort(np.argsort(-weight, axis=1, kind="stable"), axis=1, kind="stable")
        kept = there & (rank < most)
        share = np.where(kept, prior, 0)
        weight = _descend(candidates, target, share / np.maximum(share.sum(axis=1, keepdims=True), 1e-30), ridge, kept)
    # To what a weight is stored as, about: none so small that it costs a probe for nothing.
    weight[weight < 2e-3] = 0
    total = weight.sum(axis=1, keepdims=True)
    return np.asarray(np.where(total > 0, weight / np.maximum(total, 1e-30), prior), np.float32)


def _descend(candidates: Float32, target: Float32, prior: Float32, ridge: float, allowed: Bool) -> Float64:
    rows = target.shape[1]
    sums = np.float64(SUM_WEIGHT * rows)
    gram = np.matmul(candidates, candidates.transpose(0, 2, 1)).astype(np.float64) + sums
    right = np.matmul(candidates, target[:, :, None])[:, :, 0].astype(np.float64) + sums
    diagonal = np.arange(gram.shape[1])
    gram[:, diagonal, diagonal] += ridge * rows
    right += ridge * rows * prior
    # Candidate by candidate, so that each sweep runs along memory.
    gram = np.ascontiguousarray(gram.transpose(1, 2, 0))
    right, may = np.ascontiguousarray(right.T), np.ascontiguousarray(allowed.T)
    weight = np.ascontiguousarray(np.where(allowed, prior, 0).T.astype(np.float64))
    for _ in range(SWEEPS):
        for c in range(len(weight)):
            slope = right[c] - np.einsum("kn,kn->n", gram[c], weight)
            weight[c] = np.where(may[c], np.maximum(weight[c] + slope / gram[c, c], 0), 0)
    return weight.T.copy()


def relative_errors(weights: Float32, candidates: Float32, target: Float32) -> Float32:
    """(n, r): |A w - b| of blends, relative to what rows were divided by."""
    return np.abs(np.matmul(weights[:, None], candidates)[:, 0] - target)
