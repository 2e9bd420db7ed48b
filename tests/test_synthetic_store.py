"""Lit rooms are kept on disk between runs; a cache that is broken, outdated or not writable costs time only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ecslam.datasets.synthetic import store
from ecslam.datasets.synthetic.scene import Scene

SCENE = Scene(
    np.arange(66, dtype=np.int32).reshape(2, 33),
    np.linspace(0, 1, 30, dtype=np.float32).reshape(2, 15),
    np.arange(7, dtype=np.uint32),
    np.ones((5, 3), np.float32) / 3,
    np.tile(np.eye(3), (2, 1, 1)),
    np.zeros((2, 3)),
)


class Baker:
    def __init__(self) -> None:
        self.baked = 0

    def __call__(self) -> Scene:
        self.baked += 1
        return SCENE


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "ecslam"


def same(scene: Scene) -> bool:
    return all(a.dtype == b.dtype and np.array_equal(a, b) for a, b in zip(scene, SCENE, strict=True))


def test_a_room_is_baked_once_and_comes_back_bit_for_bit(folder: Path) -> None:
    bake = Baker()
    assert same(store.kept("hut", bake))
    assert same(store.kept("hut", bake))
    assert bake.baked == 1
    assert [path.suffix for path in folder.iterdir()] == [".npz"]


@pytest.mark.parametrize("cut", [0, 100, 900])
def test_a_broken_entry_is_made_again(folder: Path, cut: int) -> None:
    bake = Baker()
    store.kept("hut", bake)
    (entry,) = folder.iterdir()
    entry.write_bytes(entry.read_bytes()[:cut])
    assert same(store.kept("hut", bake))
    assert bake.baked == 2
    assert same(store.kept("hut", bake))
    assert bake.baked == 2


def test_other_program_text_makes_a_new_entry_and_removes_the_old_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bake = Baker()
    store.kept("hut", bake)
    store.kept("house", bake)
    monkeypatch.setattr(store, "_recipe", lambda: "changed")
    store.kept("hut", bake)
    assert bake.baked == 3
    names = sorted(path.name.split("-")[0] for path in folder.iterdir())
    assert names == ["house", "hut"]
    assert (folder / "hut-changed.npz").is_file()


def test_where_nothing_can_be_written_the_room_is_baked_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    bake = Baker()
    assert same(store.kept("hut", bake))
    assert same(store.kept("hut", bake))
    assert bake.baked == 2


def test_a_failed_write_leaves_nothing_behind(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*args: object, **arrays: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    assert same(store.kept("hut", Baker()))
    assert list(folder.iterdir()) == []


def test_who_has_no_home_gets_a_room_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(path: Path) -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "expanduser", nobody)
    assert same(store.kept("hut", Baker()))
