"""Memory that is freed is kept for what is made next, and given back between stages."""

import ctypes
import subprocess
import sys

import pytest

GLIBC = sys.platform == "linux" and hasattr(ctypes.CDLL(None), "mallopt")
CODE = """
from pathlib import Path
import numpy as np
from cuspid.runtime.memory import trim_heap, keep_freed

def held_mib():
    return int(Path("/proc/self/statm").read_text().split()[1]) // 256

keep_freed()
before = held_mib()
arrays = [np.ones(1 << 20) for _ in range(32)]
one = np.ones(1 << 10)
most = held_mib()
del arrays
kept = held_mib()
trim_heap()
print(most - before, kept - before, held_mib() - before)
"""


@pytest.mark.skipif(not GLIBC, reason="the C library is not glibc")
def test_what_is_freed_is_kept_until_it_is_given_back() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    most, kept, left = map(int, done.stdout.split())
    assert 250 < most < 300
    assert kept > 250
    assert left < 20
