"""The accuracy benchmark: every variant runs with every seed, a failed run is counted, figures are those of `eval`."""

import io
import os
import re

import pytest
from rich.console import Console

from ecslam.bench import accuracy
from ecslam.bench.runs import in_own_process
from ecslam.types import InputError

TINY = """
preset: lite
field: {levels: 4, log2_table_size: 12}
tracking: {iterations: 1, rays: 100}
mapping: {first_iterations: 5, iterations: 2, final_iterations: 3, rays: 100}
"""
ROOM = "synthetic/studio?size=96x72"


@pytest.mark.slow
def test_a_tiny_ablation(tmp_path):
    preset = tmp_path / "tiny.yaml"
    preset.write_text(TINY)
    result = accuracy.bench_accuracy(
        ROOM, [str(preset)], "0:6", 1, "cpu", ablate=True, surface=False, settings=["mapping.every=5"]
    )
    assert [name.removeprefix(str(preset)) for name in result["variants"]] == [
        "",
        " without FUS",
        " without EBA",
        " without both",
    ]
    for runs in result["variants"].values():
        assert len(runs) == 1
        assert runs[0]["seed"] == 0
        assert runs[0]["frames"] == 6
        assert runs[0]["ate_rmse_cm"] > 0


def test_means_deviations_and_failures_are_shown():
    runs = [{"ate_rmse_cm": 1.0}, {"ate_rmse_cm": 3.0}, {"error": "the map exploded"}]
    other = [{"ate_rmse_cm": 5.0, "depth_l1_cm": 0.75}]
    about = {"sequence": "a", "frames": "", "settings": ["fus=false"], "seeds": 3}
    text = io.StringIO()
    accuracy.print_table(about | {"variants": {"lite": runs, "full": other}}, Console(file=text, width=100))
    assert re.search(r"ATE RMSE \(cm\) +│ +2\.00 ± 1\.41 │ +5\.00", text.getvalue())
    assert re.search(r"Depth L1 \(cm\) +│ +│ +0\.75", text.getvalue())
    assert re.search(r"failed runs +│ +1 │ +0", text.getvalue())
    assert "a, fus=false, seeds: 3" in text.getvalue()
    assert "lite: 1 of 3 runs failed, the first because: the map exploded" in text.getvalue()


@pytest.mark.parametrize(
    ("job", "arguments", "says"),
    [(os._exit, (9,), "its process was killed, perhaps for lack of memory"), (divmod, (1, 0), "by zero")],
)
def test_a_run_that_fails_or_is_killed_is_counted_by_its_error(job, arguments, says):
    assert says in in_own_process(job, arguments)["error"]


def test_what_cannot_run_is_refused_before_anything_runs(tmp_path):
    with pytest.raises(InputError, match="no such preset"):
        accuracy.bench_accuracy(ROOM, ["lite", "lighter"], "0:2", 1, "cpu", ablate=False, surface=True, settings=[])
    how = {"ablate": False, "surface": True, "settings": ["maping.iterations=3"]}
    with pytest.raises(InputError, match="unknown key 'maping'"):
        accuracy.bench_accuracy(ROOM, ["lite"], "0:2", 1, "cpu", **how)
