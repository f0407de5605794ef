"""Memory of arrays that are gone is the system's again."""

import subprocess
import sys

import pytest

# Arrays of 400 kB between others that stay, as sectors come and go; once a larger one has gone, glibc would keep them all.
HOLES = """
import contextlib, os, sys
import numpy as np
from server.heap import give_memory_back, keeping_memory
from server.routes.live import memory_bytes
if sys.argv[1] != "not told" and not give_memory_back():
    sys.exit(77)
np.ones(1 << 20)
gone, stay = [], []
with keeping_memory() if sys.argv[1] == "keeping" else contextlib.nullcontext():
    for _ in range(250):
        gone.append(np.ones(50_000))
        stay.append(np.ones(1_000))
    full = memory_bytes()
    gone.clear()
    kept = full - memory_bytes() < 20e6
print(full - memory_bytes() if kept == (sys.argv[1] != "told") else -1)
"""


def returned(how: str) -> int:
    found = subprocess.run([sys.executable, "-c", HOLES, how], capture_output=True, text=True, timeout=60, check=False)
    if found.returncode == 77:
        pytest.skip("this C library cannot be told")
    assert found.returncode == 0, found.stderr
    return int(found.stdout)


def test_arrays_that_go_leave_no_holes_behind():
    assert returned("told") > 90e6  # of 100 MB


def test_what_is_kept_for_a_while_goes_back_in_the_end():
    assert returned("keeping") > 90e6


def test_without_it_they_would():
    if sys.platform != "linux":
        pytest.skip("glibc's habit")
    assert 0 <= returned("not told") < 50e6
