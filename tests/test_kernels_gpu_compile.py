"""Every GPU kernel compiles to machine code, without a GPU, with the arguments that the host code gives it."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
KERNELS = HERE.parent / "ecslam" / "kernels"
SPILLING = {"gradients_kernel", "values_kernel", "decoders_kernel", "weights_kernel", "align_kernel"}


def launched():
    """The names of all kernels."""
    trees = [ast.parse(path.read_text("utf-8")) for path in KERNELS.glob("_gpu_*.py")]
    names = {node.name for tree in trees for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    return {name for name in names if name.endswith("_kernel")}


@pytest.mark.slow
@pytest.mark.parametrize("wanted", [("80",), ("90", "variants")])
def test_every_kernel_compiles(wanted, tmp_path):
    pytest.importorskip("triton", "3.9", reason="another Triton compiles in other ways")
    environment = {**os.environ, "TRITON_CACHE_DIR": str(tmp_path), "TRITON_INTERPRET": "0", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(HERE / "gpu_compiled.py"), *wanted]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    reports = [json.loads(line) for line in done.stdout.splitlines()]
    names = [report["kernel"] for report in reports]
    assert set(names) == launched()
    assert names.count("gradients_kernel") == names.count("align_kernel") == 1
    assert all(report["cubin"] > 1000 for report in reports)
    assert {report["kernel"] for report in reports if report["spilled"]} <= SPILLING
