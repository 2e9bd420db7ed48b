"""Compiled code that is older than the source of what it calls must not be used."""

from __future__ import annotations

import os
from pathlib import Path

from ecslam.compiled import drop_stale


def put(path: Path, at: int) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text("")
    os.utime(path, (at, at))
    return path


def test_only_what_is_older_than_a_source_that_it_may_call_goes(tmp_path: Path) -> None:
    put(tmp_path / "_cpu_inner.py", 200)
    put(tmp_path / "_cpu_outer.py", 100)
    put(tmp_path / "other.py", 300)
    cache = tmp_path / "cache"
    old, new = put(cache / "_cpu_outer.run-1.nbi", 150), put(cache / "_cpu_outer.run-2.nbi", 250)
    elsewhere, code = put(cache / "other.run-1.nbi", 50), put(cache / "_cpu_outer.run-1.1.nbc", 150)
    drop_stale(tmp_path, cache, "_cpu_*")
    assert [path.exists() for path in (old, new, elsewhere, code)] == [False, True, True, True]
    drop_stale(tmp_path, cache)
    assert [path.exists() for path in (new, elsewhere)] == [False, False]


def test_a_folder_that_is_not_there_yet_is_no_error(tmp_path: Path) -> None:
    put(tmp_path / "a.py", 1)
    drop_stale(tmp_path, tmp_path / "cache")
