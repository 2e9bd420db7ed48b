"""The GPU kernels: all checked, on a GPU or in Triton's interpreter, and honest refusal where they cannot run."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from ecslam.kernels import reference, select
from ecslam.types import InputError

HERE = Path(__file__).parent


@pytest.mark.slow
@pytest.mark.parametrize("checks", ["gpu_checks.py", "gpu_volume_checks.py", "gpu_tracking_checks.py"])
def test_every_kernel_agrees_with_the_reference(checks):
    pytest.importorskip("triton", reason="Triton is not installed, so the GPU kernels are not checked")
    interpret = "0" if torch.cuda.is_available() else "1"
    environment = {**os.environ, "TRITON_INTERPRET": interpret, "OMP_NUM_THREADS": "1"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-p",
        "no:cacheprovider",
        "--timeout=0",
        str(HERE / checks),
    ]
    done = subprocess.run(command, env=environment, cwd=HERE, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
    assert " passed" in done.stdout
    assert "skipped" not in done.stdout


def failure(script: str, **environment: str) -> str:
    """The last line that a Python process with this script says on its way out."""
    done = subprocess.run([sys.executable, "-c", script], env=os.environ | environment, capture_output=True, text=True)
    assert done.returncode != 0
    return done.stderr.strip().splitlines()[-1]


def test_without_a_gpu_there_is_no_gpu_back_end():
    said = failure("from ecslam.kernels import gpu", TRITON_INTERPRET="0", CUDA_VISIBLE_DEVICES="")
    assert said == "ImportError: no CUDA device"


def test_without_triton_there_is_no_gpu_back_end():
    said = failure("import sys; sys.modules['triton'] = None; from ecslam.kernels import gpu", TRITON_INTERPRET="1")
    assert said.startswith(("ImportError", "ModuleNotFoundError"))
    assert "triton" in said


def test_a_gpu_without_the_back_end_runs_the_reference_and_says_so(monkeypatch):
    monkeypatch.delenv("ECSLAM_KERNELS", raising=False)
    monkeypatch.setitem(sys.modules, "ecslam.kernels.gpu", None)
    name, backend, note = select(torch.device("cuda"))
    assert (name, backend) == ("reference", reference)
    assert "gpu kernels cannot run here" in note
    monkeypatch.setenv("ECSLAM_KERNELS", "gpu")
    with pytest.raises(InputError, match="cannot run here"):
        select(torch.device("cuda"))
