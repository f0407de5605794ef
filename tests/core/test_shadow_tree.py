"""Trees of triangles: all there once, boxes that hold what is below them, a walk by ``skip`` that visits every node or jumps past it."""

import numpy as np
import pytest

from gi_core.shadow_tree import LEAF_TRIANGLES, build_tree


def random_triangles(count: int, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(-10, 70, (count, 1, 3)) + rng.normal(size=(count, 3, 3)) * 4


@pytest.mark.parametrize("count", [1, 2, 4, 5, 7, 8, 9, 100, 1000, 1027])
def test_every_triangle_is_in_one_leaf_and_in_all_boxes_above_it(count):
    corners = random_triangles(count)
    tree = build_tree(corners)
    leaves = tree.nodes["leaf"][tree.nodes["leaf"] > 0]
    first, size = leaves >> 3, leaves & 7
    assert size.max() <= LEAF_TRIANGLES
    assert np.concatenate([np.arange(f, f + s) for f, s in zip(first, size, strict=True)]).tolist() == list(range(count))
    # Corners come back from float32 and a sum.
    found = tree.corners[np.lexsort(tree.corners[:, 0].T)]
    np.testing.assert_allclose(found, corners[np.lexsort(corners.astype(np.float32)[:, 0].T)], atol=2e-5)
    for i, node in enumerate(tree.nodes):
        below = tree.nodes[i : node["skip"]]
        held = below["leaf"][below["leaf"] > 0]
        inside = tree.corners[held[0] >> 3 : (held[-1] >> 3) + (held[-1] & 7)]
        assert (inside >= node["low"]).all()
        assert (inside <= node["high"]).all()
        assert i < node["skip"] <= len(tree.nodes)


@pytest.mark.parametrize("count", [1, 6, 33, 500])
def test_a_walk_that_misses_a_box_goes_on_beside_it(count):
    nodes = build_tree(random_triangles(count)).nodes

    def subtree(i: int) -> int:
        """Where a node's subtree ends, by its children: the first is next, the second follows the first's end."""
        end = i + 1 if nodes["leaf"][i] else subtree(subtree(i + 1))
        assert nodes["skip"][i] == end
        return end

    assert subtree(0) == len(nodes)


def test_no_triangles_are_no_nodes():
    tree = build_tree(np.zeros((0, 3, 3)))
    assert len(tree.nodes) == len(tree.triangles) == tree.nbytes == 0


def test_the_same_triangles_give_the_same_bytes_though_many_are_alike():
    corners = np.repeat(random_triangles(20), 30, axis=0)
    first, second = build_tree(corners), build_tree(corners.copy())
    assert first.nodes.tobytes() == second.nodes.tobytes()
    assert first.triangles.tobytes() == second.triangles.tobytes()
