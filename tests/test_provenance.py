"""What made a result can be read beside it."""

import shutil
import subprocess

import pytest
import torch
from typer.testing import CliRunner

from ecslam import __version__, provenance
from ecslam.cli import app
from ecslam.cores import cores

needs_git = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """The package as if it lay in a folder of its own."""
    folder = tmp_path / "clone"
    folder.mkdir()
    monkeypatch.setattr(provenance, "__file__", str(folder / "ecslam" / "provenance.py"))
    return folder


def test_version_says_what_is_installed_and_on_what(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    result = CliRunner().invoke(app, ["--version"])
    assert result.exit_code == 0
    for part in (f"ecslam   {__version__}", f"torch    {torch.__version__}", f"{cores()} cores"):
        assert part in result.output


@needs_git
def test_an_installed_package_has_its_version_whatever_lies_above_it(elsewhere):
    subprocess.run(["git", "init", "-q", elsewhere.parent], check=True)
    assert provenance.software() == __version__


@needs_git
def test_a_clone_says_its_commit_and_that_it_was_changed(elsewhere):
    def git(*words):
        return subprocess.run(
            ["git", "-C", elsewhere, "-c", "user.name=a", "-c", "user.email=a@b", *words],
            check=True, capture_output=True, text=True,
        ).stdout.strip()  # fmt: skip

    (elsewhere / "file").write_text("1")
    git("init", "-q")
    assert provenance.software() == __version__  # no commit yet
    git("add", "file")
    git("commit", "-qm", "First")
    commit = git("rev-parse", "--short", "HEAD")
    assert provenance.software() == f"{__version__} ({commit})"
    (elsewhere / "file").write_text("2")
    assert provenance.software() == f"{__version__} ({commit}-dirty)"


def test_without_git_there_is_still_a_version(elsewhere, monkeypatch):
    (elsewhere / ".git").mkdir()
    monkeypatch.setenv("PATH", str(elsewhere))
    assert provenance.software() == __version__
