"""Background threads give way to ticks, and are not starved by them."""

import threading
import time

from gi_core.background import MOST_AHEAD_S, RightOfWay, background_thread, give_way


def steps_until(stop: threading.Event) -> list[float]:
    """When a thread got on, between steps that take no time [s]."""
    times = []
    while not stop.is_set():
        give_way()
        times.append(time.perf_counter())
        time.sleep(0.0005)
    return times


def test_a_thread_stands_still_while_a_tick_runs():
    ticks, stop = RightOfWay(), threading.Event()
    with background_thread("test", ticks) as thread:
        running = thread.submit(steps_until, stop)
        time.sleep(0.05)
        with ticks.taken():
            began = time.perf_counter()
            time.sleep(MOST_AHEAD_S / 2)
            ended = time.perf_counter()
        time.sleep(0.02)
        stop.set()
        times = running.result()
    # One step may have been under way.
    assert sum(began + 0.005 < at < ended for at in times) == 0
    assert any(at < began for at in times)
    assert any(at > ended for at in times)


def test_ticks_without_end_leave_a_thread_its_share():
    ticks, stop = RightOfWay(), threading.Event()
    with background_thread("test", ticks) as thread, ticks.taken():
        running = thread.submit(steps_until, stop)
        time.sleep(1.0)
        stop.set()
        times = running.result()
    late = [at for at in times if at > times[0] + 2 * MOST_AHEAD_S]
    assert len(late) > 50  # of a thousand steps of a millisecond it could make half


def test_other_threads_do_not_wait():
    ticks = RightOfWay()
    with ticks.taken():
        began = time.perf_counter()
        for _ in range(100):
            give_way()
        assert time.perf_counter() - began < MOST_AHEAD_S


def test_the_way_is_free_again_after_a_tick_that_fails():
    ticks = RightOfWay()
    try:
        with ticks.taken():
            raise RuntimeError
    except RuntimeError:
        pass
    began = time.perf_counter()
    ticks.wait(5.0)
    assert time.perf_counter() - began < 1.0
