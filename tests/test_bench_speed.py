"""The speed benchmark: its figures agree with each other, growth is what it says, a missing rival is said."""

import importlib.util
import io
import re
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from ecslam.bench import speed
from ecslam.bench.peer import open3d_missing
from ecslam.bench.runs import preset_config
from ecslam.config_files import apply_settings, for_layout, load_preset
from ecslam.types import InputError

TINY = """
preset: lite
field: {levels: 4, log2_table_size: 12}
tracking: {iterations: 2, rays: 100}
mapping: {first_iterations: 5, iterations: 2, rays: 100}
"""
ROOM = "synthetic/studio?size=96x72"


@pytest.mark.slow
def test_speed_of_a_tiny_run(tmp_path):
    (tmp_path / "tiny.yaml").write_text(TINY)
    preset = str(tmp_path / "tiny.yaml")
    result = speed.bench_speed(ROOM, [preset], "0:12", 1, "cpu", peer=importlib.util.find_spec("open3d") is None)
    m = result["presets"][preset]
    assert m["frames_done"] == 12
    assert len(m["cost_ms"]) == 11
    assert np.mean(m["cost_ms"]) == pytest.approx(m["track_ms"] + m["map_ms"])
    assert m["fps_engine"] == pytest.approx(1e3 / (m["track_ms"] + m["map_ms"]), rel=1e-3)
    assert 0 < m["fps_wall"] < m["fps_engine"]
    assert m["stored_keyframes_mb"] > 0
    assert m["cost_growth"] is None
    assert m["memory_frame"][-1] == 11
    assert 0 < min(m["memory_mb"]) <= max(m["memory_mb"]) <= 1.01 * m["peak_memory_mb"]
    text = io.StringIO()
    speed.print_table(result, Console(file=text, width=200))
    assert f"{m['fps_wall']:.2f}" in text.getvalue()
    assert result["peer_note"] in text.getvalue().replace("\n", " ")
    speed.plot_speed(result, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").read_bytes().startswith(b"\x89PNG")


def test_growth_compares_the_end_with_frames_200_to_400():
    frames = np.arange(1, 1000)
    cost = np.where(frames < 400, 10.0, 10.0 + (frames - 400) / 60)
    memory = {frame: 500.0 + frame / 10 for frame in range(0, 1000, 3)}
    keyframes = np.arange(0, 1000, 5)
    growth = speed._growth(cost, memory, keyframes, stored_mb=200.0)
    assert growth["cost_growth"] == pytest.approx(cost[frames >= 800].mean() / 10)
    assert growth["memory_growth_mb"] == pytest.approx(60, abs=0.2)
    assert growth["keyframe_growth_mb"] == pytest.approx(120)
    assert growth["other_growth_mb"] == pytest.approx(-60, abs=0.2)
    assert set(speed._growth(cost[:598], memory, keyframes, 200.0).values()) == {None}


def test_medians_go_key_by_key_and_frame_by_frame():
    runs = [
        {"fps_wall": v, "ate_rmse_cm": None, "cost_ms": c} for v, c in ((1.0, [1, 9]), (5.0, [2, 7]), (2.0, [3, 8]))
    ]
    assert speed._medians(runs) == {"fps_wall": 2.0, "ate_rmse_cm": None, "cost_ms": [2, 8]}


def test_the_ratio_to_the_rival_is_printed():
    m = dict.fromkeys(("track_ms", "map_ms", "peak_memory_mb", "stored_keyframes_mb", "fps_engine"), 1.0)
    m |= {"fps_wall": 12.0, "ate_rmse_cm": None, "cost_growth": 1.05}
    m |= {"memory_growth_mb": 30.0, "keyframe_growth_mb": 31.5}
    rival = {"fps_wall": 6.0, "ate_rmse_cm": 2.1}
    about = {"sequence": "a", "frames": "", "machine": "x", "repeats": 3, "peer_note": ""}
    text = io.StringIO()
    result = about | {"presets": {"live": m}, "errors": {"live": []}, "peer": rival, "ratio": {"live": 2.0}}
    speed.print_table(result, Console(file=text, width=200))
    assert re.search(r"times the rival's frames/s +│ +2\.00", text.getvalue())
    assert "30.00" in text.getvalue()


def test_runs_that_fail_are_counted_and_not_averaged_away(monkeypatch):
    turns = {"live": [6.0, None, 8.0], "lite": [None, None, None]}

    def run(job, arguments):
        rate = turns[arguments[1]].pop(0)
        return {"error": "the map exploded"} if rate is None else {"fps_wall": rate, "cost_ms": [], "memory_frame": []}

    monkeypatch.setattr(speed, "in_own_process", run)
    result = speed.bench_speed(ROOM, ["live", "lite"], "0:2", 3, "cpu")
    assert list(result["presets"]) == ["live"]
    assert result["presets"]["live"]["fps_wall"] == 7.0
    assert result["errors"] == {"live": ["the map exploded"], "lite": 3 * ["the map exploded"]}
    text = io.StringIO()
    speed.print_table(result, Console(file=text, width=200))
    assert "live: 1 of 3 runs failed, the first because: the map exploded" in text.getvalue()
    assert "lite: 3 of 3 runs failed" in text.getvalue()


def test_a_preset_file_begins_from_what_the_layout_asks_for(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("preset: full\nseed: 3")
    sequence = SimpleNamespace(preset="lite", layout="tum")
    assert preset_config(str(path), sequence) == apply_settings(for_layout(load_preset("full"), "tum"), ["seed=3"])


def test_a_wrong_preset_is_refused_before_anything_runs():
    with pytest.raises(InputError, match="no such preset"):
        speed.bench_speed(ROOM, ["lite", "lighter"], "0:2", 1, "cpu")


def test_a_missing_rival_is_said(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "not installed" in open3d_missing()
