"""Shared by all tests: where real recordings may lie, and no example of a property is too slow on a busy machine."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

ROOT = Path(__file__).parent.parent
settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder with the real recordings; skips where there is none."""
    folder = Path(os.environ.get("ECSLAM_RECORDINGS", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no real recordings here (set ECSLAM_RECORDINGS to their folder)")
    return folder
