"""Memory: what was freed goes back to the system, among small things that stay."""

import subprocess
import sys

import pytest

from ecslam.runtime.memory import peak_memory_mb, resident_mb

HOLES = """
import numpy as np
from ecslam.runtime.memory import resident_mb, keep_no_holes
keep_no_holes()
np.ones(30 << 20, np.uint8)
before = resident_mb()
blocks, small = [], []
for _ in range(24):
    blocks.append(np.ones(6 << 20, np.uint8))
    small.append(np.ones(100 << 10, np.uint8))
held = resident_mb() - before
del blocks
print(held, resident_mb() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems return memory by their own rules")
def test_holes_go_back_to_the_system():
    program = [sys.executable, "-c", HOLES]
    held, left = map(float, subprocess.run(program, capture_output=True, text=True, check=True).stdout.split())
    assert held > 120
    assert left < 20


SHARED = """
import threading
import numpy as np
from ecslam.runtime.memory import keep_no_holes, resident_mb
keep_no_holes()
kept, before, together = [], resident_mb(), threading.Barrier(16)
lock = threading.Lock()
def work():
    together.wait()
    with lock:
        large = np.ones(1 << 20, np.uint8)
        kept.append(np.ones(1 << 10, np.uint8))
        del large
    together.wait()
threads = [threading.Thread(target=work) for _ in range(16)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
print(resident_mb() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems return memory by their own rules")
def test_a_thread_reuses_what_another_has_freed():
    program = [sys.executable, "-c", SHARED]
    assert float(subprocess.run(program, capture_output=True, text=True, check=True).stdout) < 6


IMAGES = """
import resource
import numpy as np
from ecslam.runtime.memory import keep_no_holes
keep_no_holes()
def look():
    return np.ones((680, 1200, 3), np.uint8), np.ones((680, 1200), np.float32)
look()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    look()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems return memory by their own rules")
def test_images_take_the_memory_of_those_before():
    program = [sys.executable, "-c", IMAGES]
    faults = int(subprocess.run(program, capture_output=True, text=True, check=True).stdout)
    assert faults < 1000  # 20 images of 5.7 MB anew would be 27,000 pages


GAPS = """
import numpy as np
from ecslam.runtime.memory import resident_mb, return_holes
blocks, small = [], []
for _ in range(400):
    blocks.append(np.ones(100 << 10, np.uint8))
    small.append(np.ones(1 << 10, np.uint8))
before = resident_mb()
del blocks
return_holes()
print(before - resident_mb())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="other systems return memory by their own rules")
def test_gaps_between_small_blocks_go_back_when_asked():
    program = [sys.executable, "-c", GAPS]
    assert float(subprocess.run(program, capture_output=True, text=True, check=True).stdout) > 30


def test_resident_memory_is_below_its_peak():
    assert 10 < resident_mb() <= peak_memory_mb() + 1


IMPORTED = """
import gc
from ecslam.runtime.driven import import_slam
looked = []
gc.callbacks.append(lambda phase, info: looked.append(info["generation"]))
import_slam()
during = looked.count(2)
import_slam()
print(gc.isenabled(), during, len(gc.get_objects()), gc.get_freeze_count())
"""


def test_no_search_for_garbage_goes_through_the_libraries():
    done = subprocess.run([sys.executable, "-c", IMPORTED], capture_output=True, text=True, check=True)
    enabled, during, searched, left_out = done.stdout.split()
    assert (enabled, during) == ("True", "0")
    assert int(searched) < 0.05 * int(left_out)
