"""The kernel benchmark compares the back ends on the same work and prints what it measured."""

import io

import pytest
from rich.console import Console

from ecslam.bench.kernels import bench_kernels, print_table
from ecslam.types import InputError


@pytest.mark.slow
def test_ratios_are_those_of_the_medians():
    result = bench_kernels(rays=20, repeats=3, device="cpu")
    assert set(result["milliseconds"]) == {"mapping step", "tracking step", "values", "normal equations"}
    for job, times in result["milliseconds"].items():
        assert times["cpu"] > 0
        assert result["ratio"][job] == pytest.approx(times["reference"] / times["cpu"])
        assert result["times_floor"][job] == pytest.approx(times["cpu"] / result["floor_milliseconds"][job])
    floors = result["floor_milliseconds"]
    assert 0 < floors["normal equations"] < floors["values"]
    assert 0 < floors["tracking step"] <= floors["mapping step"]
    text = io.StringIO()
    print_table(result, Console(file=text, width=120))
    assert "mapping step" in text.getvalue()
    assert "860 samples on 20 rays" in text.getvalue()


def test_too_few_repeats_are_refused():
    with pytest.raises(InputError, match="at least 3"):
        bench_kernels(repeats=2)
