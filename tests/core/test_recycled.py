"""Memory that is lent again: never while somebody can still see it."""

import numpy as np

from gi_core.recycled import KEPT, RecycledArrays


def place_of(array: np.ndarray) -> int:
    return int(array.__array_interface__["data"][0])


def test_memory_returns_when_the_last_view_is_gone():
    arrays = RecycledArrays((4, 5, 3))
    first = arrays.take()
    assert first.shape == (4, 5, 3)
    place = place_of(first)
    view = first[1:3].reshape(-1)[2:]
    del first
    assert place_of(arrays.take()) != place
    view[:] = 7
    assert (view == 7).all()
    del view
    assert place_of(arrays.take()) == place


def test_read_only_arrays_come_back_writable():
    arrays = RecycledArrays((3,))
    first = arrays.take()
    first.setflags(write=False)
    del first
    arrays.take()[:] = 1.0


def test_no_more_is_kept_than_a_few():
    arrays = RecycledArrays((8,))
    held = [arrays.take() for _ in range(3 * KEPT)]
    places = {place_of(array) for array in held}
    assert len(places) == 3 * KEPT
    held.clear()
    again = [arrays.take() for _ in range(3 * KEPT)]
    assert len({place_of(array) for array in again}) == 3 * KEPT
