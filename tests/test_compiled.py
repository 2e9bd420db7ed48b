"""Compiled code has a place, and what is older than the source of what it calls is not used."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ecslam.compiled import drop_stale, find_place


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


@pytest.fixture
def no_folder_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # what follows is undone
    monkeypatch.delenv("NUMBA_CACHE_DIR")


@pytest.mark.usefixtures("no_folder_named")
def test_there_is_a_place_where_neither_package_nor_cache_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.warns(UserWarning, match="name a folder for them in NUMBA_CACHE_DIR"):
        find_place(tmp_path)
    place = Path(os.environ["NUMBA_CACHE_DIR"])
    assert place.is_dir()
    assert place.stat().st_mode & 0o77 == 0
    find_place(tmp_path)
    assert os.environ["NUMBA_CACHE_DIR"] == str(place)


@pytest.mark.usefixtures("no_folder_named")
@pytest.mark.parametrize("cache", ["", "/dev/null"])
def test_numba_is_left_alone_where_the_package_can_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cache: str
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", cache)
    find_place(tmp_path)
    assert "NUMBA_CACHE_DIR" not in os.environ
