"""EC-SLAM: effectively constrained neural RGB-D SLAM.

An independent implementation of Li et al., "EC-SLAM: Effectively Constrained Neural RGB-D SLAM with Sparse TSDF
Encoding and Global Bundle Adjustment" (2024). Start reading at ``slam.py``: it holds the whole method on one screen.
"""

from pathlib import Path

from .compiled import find_place

__version__ = "0.1.0"

find_place(Path(__file__).parent / "kernels")
