"""Memory of arrays that are gone is the system's again."""

import subprocess
import sys

import pytest

# Arrays of 400 kB between others that stay, as sectors come and go; once a larger one has gone, glibc would keep them all.
HOLES = """
import os, sys
import numpy as np
from server.heap import give_memory_back
from server.routes.live import memory_bytes
if sys.argv[1] == "told" and not give_memory_back():
    sys.exit(77)
np.ones(1 << 20)
gone, stay = [], []
for _ in range(250):
    gone.append(np.ones(50_000))
    stay.append(np.ones(1_000))
full = memory_bytes()
gone.clear()
print(full - memory_bytes())
"""


def returned(how: str) -> int:
    found = subprocess.run([sys.executable, "-c", HOLES, how], capture_output=True, text=True, timeout=60, check=False)
    if found.returncode == 77:
        pytest.skip("this C library cannot be told")
    assert found.returncode == 0, found.stderr
    return int(found.stdout)


def test_arrays_that_go_leave_no_holes_behind():
    assert returned("told") > 90e6  # of 100 MB


def test_without_it_they_would():
    if sys.platform != "linux":
        pytest.skip("glibc's habit")
    assert returned("not told") < 50e6
