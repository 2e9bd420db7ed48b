"""The CPU kernels as other processors and other runs compile them: this file, run as a program, prints a digest of what
they find and stops where that is far from the float64 reference."""

import hashlib
import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from kernel_cases import ALIGN, WEIGHTS, blank, double, make_field, make_points, make_rays, relative_rms

from ecslam.field_adam import FieldAdam

CLOSE = 1e-4
pytest.importorskip("ecslam.kernels.cpu")


def tensors(kernels, exact):
    """All that the kernels find at one field, one batch of rays and some points, in float64 where ``exact``."""
    field, points = make_field(), make_points(700)
    (c2w, rays), light = make_rays(100, 43), torch.rand(700, generator=torch.Generator().manual_seed(1))
    params, pose = field.params, torch.eye(4)
    if exact:
        params, c2w, rays, points = double(params), c2w.double(), double(rays), points.double()
    into = blank(params)
    step = kernels.step(field.layout, params, c2w, rays, WEIGHTS, into, True)
    tracked = kernels.step(field.layout, params, c2w, rays, WEIGHTS, None, True)
    normal = kernels.normal_equations(field.layout, params, pose.to(points), points, light.to(points), ALIGN)
    return [
        *kernels.values(field.layout, params, points),
        *kernels.gradients(field.layout, params, points),
        *kernels.render(field.layout, params, c2w, rays),
        *(step.losses, step.d_c2w, tracked.losses, tracked.d_c2w, normal.jtj, normal.jtr),
        *(getattr(into, f.name) for f in fields(into) if f.name != "beta"),
    ]


def digest():
    from ecslam.kernels import cpu, reference

    found = tensors(cpu, exact=False)
    for i, (mine, theirs) in enumerate(zip(found, tensors(reference, exact=True), strict=True)):
        assert relative_rms(mine, theirs) < CLOSE, i
    return hashlib.sha256(b"".join(t.contiguous().numpy().tobytes() for t in [*found, *learnt(cpu)])).hexdigest()


def learnt(kernels):
    """A table after two steps of Adam: one at once, one by itself."""
    field, (c2w, rays) = make_field(), make_rays(100, 43)
    adam, into = FieldAdam([field.params.table]), blank(field.params)
    kernels.step(field.layout, field.params, c2w, rays, WEIGHTS, into, False, adam.steps(1e-2, 0)[0])
    kernels.map_step([field.params.table], [into.table], adam.steps(1e-2, 0)[0])
    return [field.params.table, *adam.mean, *adam.square]


def run(folder, **environment):
    """The digest that a process of its own prints, with compiled code in ``folder``."""
    env = {**os.environ, "NUMBA_CACHE_DIR": str(folder), **environment}
    done = subprocess.run([sys.executable, __file__], env=env, capture_output=True, text=True, check=False)
    assert not done.returncode, done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_run_that_compiles_the_kernels_finds_the_same_bits_as_later_ones(tmp_path):
    first = run(tmp_path)
    assert list(tmp_path.rglob("*step_worker*.nbc"))
    assert run(tmp_path) == first


@pytest.mark.slow
def test_kernels_compiled_for_the_least_of_processors_are_as_exact(tmp_path):
    run(tmp_path, NUMBA_CPU_NAME="generic", NUMBA_CPU_FEATURES="")


if __name__ == "__main__":
    assert Path(sys.path[0]) == Path(__file__).parent
    print(digest())
