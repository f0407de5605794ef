"""Which queue a thread's work goes into."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from gi_core.device import Device


def test_work_beside_others_has_a_queue_of_its_own_and_is_done_at_the_end():
    device = Device()
    with device.beside():
        assert device.queue not in device.lanes
        held, found = device.upload(np.arange(4.0)), np.zeros(4)
        device.read(held, found)
        with ThreadPoolExecutor(1) as other:
            assert other.submit(lambda: device.queue).result() is device.lanes[0]
        zeros = device.allocate(1 << 20)
    assert device.queue is device.lanes[0]
    np.testing.assert_array_equal(found, np.arange(4.0))
    many = np.ones(1 << 18, np.float32)
    device.read(zeros, many)
    assert not many.any()


def test_a_queue_of_its_own_is_given_up_after_a_failure():
    device = Device()
    with pytest.raises(OSError, match="no file"), device.beside():
        raise OSError("no file")
    assert device.queue is device.lanes[0]
