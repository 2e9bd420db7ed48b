"""Which sequences a folder holds, for the dashboard's choice."""

import errno
import os
import shutil
from pathlib import Path

import pytest

from ecslam import commands
from ecslam.datasets import open_sequence
from ecslam.datasets.roots import sequences_under
from ecslam.datasets.synthetic import write_replica
from ecslam.types import InputError


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    room = open_sequence("synthetic/studio?size=32x24&frames=2")
    write_replica(room, root / "b")
    for name in ("a/deep/er", "a/far/too/deep", ".hidden/c"):
        shutil.copytree(root / "b", root / name)
    (root / "notes").mkdir()
    (root / "notes" / "a.txt").write_text("nothing")
    return root


def test_every_sequence_is_found_in_order_and_opens(root):
    found = sequences_under(root)
    assert found == (str(root / "a" / "deep" / "er"), str(root / "b"))
    assert [len(open_sequence(address)) for address in found] == [2, 2]


def test_a_sequence_is_its_own_root(root):
    assert sequences_under(root / "b") == (str(root / "b"),)


@pytest.mark.parametrize(("name", "says"), [("notes", "no sequence in it"), ("absent", "no such folder")])
def test_a_root_without_sequences_is_an_error(root, name, says):
    with pytest.raises(InputError, match=says):
        sequences_under(root / name)


def test_a_folder_that_cannot_be_read_is_passed_over(root, tmp_path, monkeypatch):
    shutil.copytree(root / "b", tmp_path / "room")
    (tmp_path / "lost+found").mkdir()
    listed = Path.iterdir

    def guarded(folder):
        if folder.name == "lost+found":
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(folder))
        return listed(folder)

    monkeypatch.setattr(Path, "iterdir", guarded)
    assert sequences_under(tmp_path) == (str(tmp_path / "room"),)
    with pytest.raises(InputError, match=f"did you mean {tmp_path / 'room'}"):
        open_sequence(tmp_path)


def test_the_dashboard_offers_the_rooms_and_what_the_roots_hold(root):
    assert commands.offered([]) == commands.BUILT_IN
    assert commands.offered([root]) == (*commands.BUILT_IN, *sequences_under(root))
