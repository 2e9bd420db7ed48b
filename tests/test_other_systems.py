"""What other operating systems lack, and where a disk, a locale or a processor differs from the usual."""

import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from ecslam_app.listen import bind

MAKEFILE = Path(__file__).parent.parent / "Makefile"
PYTHON_WITHOUT_PIP = """#!/bin/sh
[ "$1" = -m ] || exit 0
mkdir -p "$3/bin"
touch "$3/bin/python"
[ -e pip_is_there ] && touch "$3/bin/pip"
"""
WITHOUT_POSIX = """
import sys
sys.modules |= {"fcntl": None, "resource": None}  # as on Windows
from pathlib import Path
from ecslam import commands
from ecslam.runtime.engine import Engine
from ecslam.runtime.summary import peak_memory_mb
engine = Engine(commands.config_files.load_preset("live"), "synthetic/studio?size=64x48&frames=2", Path(sys.argv[1]))
assert engine.run()["frames"] == 2
assert peak_memory_mb() != peak_memory_mb()
"""


@pytest.mark.slow
def test_an_engine_runs_without_the_modules_of_unix(tmp_path):
    subprocess.run([sys.executable, "-c", WITHOUT_POSIX, str(tmp_path / "run")], check=True)
    assert '"peak_memory_mb":null' in (tmp_path / "run" / "summary.json").read_text()


@pytest.mark.parametrize("system", ["posix", "nt"])
def test_a_port_is_reused_at_once_only_where_that_shares_none_that_is_busy(monkeypatch, system):
    monkeypatch.setattr(os, "name", system)
    listener = bind("127.0.0.1", 0)
    monkeypatch.undo()
    with listener:
        assert bool(listener.getsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR)) == (system == "posix")


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_a_half_made_environment_is_made_anew(tmp_path):
    (tmp_path / "python").write_text(PYTHON_WITHOUT_PIP)
    (tmp_path / "python").chmod(0o755)
    command = ["make", "-f", str(MAKEFILE), "PYTHON=./python", ".venv/bin/pip"]
    assert subprocess.run(command, cwd=tmp_path, capture_output=True).returncode
    (tmp_path / "pip_is_there").touch()
    subprocess.run(command, cwd=tmp_path, capture_output=True, check=True)
    assert (tmp_path / ".venv/bin/pip").exists()
