"""Workers that are just starting: they must not die of the Ctrl-C that their parent handles, and have one thread each."""

import os
import signal
import subprocess
import sys

import pytest

from bake_jobs.runner import _interrupts_held, _one_thread_each

IS_BLOCKED = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))"


def started_process_says() -> str:
    return subprocess.run([sys.executable, "-c", IS_BLOCKED], capture_output=True, text=True, timeout=60, check=True).stdout.strip()


def test_only_processes_started_in_the_block_never_see_an_interrupt() -> None:
    with _interrupts_held():
        assert started_process_says() == "True"
    assert started_process_says() == "False"


def test_an_interrupt_in_the_block_reaches_the_parent_when_it_ends() -> None:
    reached_the_end = False

    def interrupt_within() -> None:
        nonlocal reached_the_end
        with _interrupts_held():
            signal.raise_signal(signal.SIGINT)
            reached_the_end = True

    # A shell has what it starts in the background ignore interrupts.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupt_within()
    finally:
        signal.signal(signal.SIGINT, before)
    assert reached_the_end


def test_processes_started_in_the_block_have_one_thread_but_where_they_were_given_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    with _one_thread_each():
        assert (os.environ["OPENBLAS_NUM_THREADS"], os.environ["OMP_NUM_THREADS"]) == ("1", "3")
    assert "OPENBLAS_NUM_THREADS" not in os.environ
    assert os.environ["OMP_NUM_THREADS"] == "3"
