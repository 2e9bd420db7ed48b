"""The viewers' benchmark: blocks in turn, each with its rate, and a run too short for a pair."""

import io

import pytest
from rich.console import Console

from ecslam import commands
from ecslam.bench import viewers
from ecslam.types import InputError

TINY = """
preset: lite
field: {levels: 4, log2_table_size: 12}
tracking: {iterations: 2, rays: 100}
mapping: {first_iterations: 5, iterations: 2, rays: 100}
"""


@pytest.mark.slow
def test_viewers_of_a_tiny_run(tmp_path, monkeypatch):
    monkeypatch.setattr(viewers, "BLOCK", 5)
    (tmp_path / "tiny.yaml").write_text(TINY)
    room, preset = "synthetic/studio?size=96x72&frames=2000", str(tmp_path / "tiny.yaml")
    result = commands.bench_viewers(room, preset, "", 3, 1, "cpu")
    assert result["viewers"] == 3
    assert len(result["fps_alone"]) == len(result["fps_watched"]) == 1
    assert min(result["fps_alone"]) > 0
    assert 0 < result["first_mesh_s"] < result["first_map_s"]
    text = io.StringIO()
    viewers.print_result(result, Console(file=text, width=200))
    assert f"{result['ratio']:.2f} times" in text.getvalue()
    assert f"first mesh {result['first_mesh_s']:.1f} s after the start" in text.getvalue()
    with pytest.raises(InputError, match="too short"):
        commands.bench_viewers(room, preset, "0:4", 3, 1, "cpu")
