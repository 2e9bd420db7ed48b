"""Strict configuration: nothing is silently ignored."""

import dataclasses

import pytest

from ecslam import config_files
from ecslam.config import Config
from ecslam.config_files import apply_settings, for_layout, load_config, load_preset, preset_names, to_yaml
from ecslam.types import InputError


def test_defaults_are_the_papers_lite_preset():
    assert load_preset("lite") == Config()


@pytest.mark.parametrize(
    ("preset", "mapping", "tracking", "samples"),
    [
        ("lite", (10, 2000), (8, 1000), (32, 11)),
        ("full", (20, 4000), (20, 2000), (32, 11)),
        ("scannet", (10, 4000), (10, 2000), (96, 21)),
        ("tum", (20, 2000), (20, 2000), (64, 21)),
    ],
)
def test_presets_carry_the_papers_counts(preset, mapping, tracking, samples):
    c = load_preset(preset)
    assert (c.mapping.iterations, c.mapping.rays) == mapping
    assert (c.tracking.iterations, c.tracking.rays) == tracking
    assert (c.sampling.uniform, c.sampling.near_depth) == samples
    assert c.preset == preset


@pytest.mark.parametrize("preset", preset_names())
def test_resolved_configuration_reads_back_equal(preset, tmp_path):
    c = load_preset(preset)
    path = tmp_path / "config.yaml"
    path.write_text(to_yaml(c))
    assert load_config(path) == c


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("mapping.iteratons=3", "did you mean 'mapping.iterations'"),
        ("iterations=3", "did you mean"),
        ("mapping.iterations=2.5", "must be a whole number"),
        ("mapping.iterations=many", "must be a whole number"),
        ("mapping.iterations=-1", "out of range"),
        ("fus=1", "must be true or false"),
        ("schedule=fast", "strict, overlap"),
        ("truncation_m=.nan", "must be a number"),
        ("mapping=3", "must hold keys"),
        ("field.box=[0, 1]", r"--set: field.box = \[0.0, 1.0\] takes six numbers"),
        ("field.box=[0, 0, 0, 1, 0, 1]", "each minimum below its maximum"),
        ("field.box=[a, 0, 0, 1, 1, 1]", r"field.box must be a list of numbers, not a list \['a', 0"),
        ("align.kernels_m=[]", "align.kernels_m .* one or more lengths above 0"),
        ("align.kernels_m=[0.06, -0.02]", "align.kernels_m .* above 0"),
        ("align.kernels_m=0.06", "align.kernels_m must be a list of numbers, not the number 0.06"),
        ("align.gradient_range=[0.5]", "align.gradient_range .* takes two numbers"),
        ("align.gradient_range=[1.3, 0.75]", "align.gradient_range .* the lower one first"),
        ("depth_near_m=9", "--set: depth_near_m = 9 must be smaller than depth_far_m = 8; change one of them"),
        ("seed", "key=value"),
        ("preset=full", "choose it with --preset"),
    ],
)
def test_wrong_settings_say_what_and_where(setting, says):
    with pytest.raises(InputError, match=says) as error:
        apply_settings(Config(), [setting])
    assert "\n" not in str(error.value)


def test_something_must_track():
    live = load_preset("live")
    with pytest.raises(InputError, match=r"--set: align.to is none and tracking.iterations is 0"):
        apply_settings(live, ["align.to=none"])
    assert apply_settings(live, ["align.to=none", "tracking.iterations=8"]).align.to == "none"


def test_settings_of_one_group_add_up_and_the_last_of_a_key_counts():
    c = apply_settings(Config(), ["mapping={rays: 50, every: 10}", "mapping.rays=60", "seed=1", "seed=2"])
    assert (c.mapping.rays, c.mapping.every, c.mapping.iterations, c.seed) == (60, 10, 10, 2)


def test_changes_are_what_leads_from_one_configuration_to_another():
    live, full = load_preset("live"), load_preset("full")
    assert config_files.apply(live, config_files.changes(live, full), "here") == full
    assert config_files.changes(live, apply_settings(live, ["mapping.rays=99"])) == {"mapping": {"rays": 99}}


def test_scientific_notation_is_a_number():
    assert apply_settings(Config(), ["mapping.lr_grid=1e-3"]).mapping.lr_grid == 1e-3


def test_a_file_starts_from_the_preset_that_it_names(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("preset: full\nmapping: {every: 10}")
    full = load_preset("full")
    wanted = dataclasses.replace(full, mapping=dataclasses.replace(full.mapping, every=10))
    assert load_config(path) == wanted
    assert load_config(path, load_preset("live"), "synthetic") == wanted
    assert load_config(path, load_preset("live"), "tum") == for_layout(wanted, "tum")
    path.write_text("mapping: {every: 10}")
    assert load_config(path, full) == wanted


def test_a_dotted_key_in_a_file_is_answered_with_how_to_nest_it(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("mapping.iterations: 3")
    with pytest.raises(InputError, match=r"unknown key 'mapping.iterations'; write it as mapping: {iterations: ...}$"):
        load_config(path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a: &x [1]\nb: *x", "aliases"),
        ("seed: 1\nseed: 2", "stands twice"),
        ("seed: [", "not valid YAML"),
        ("x" * 70_000, "KiB"),
        ("!!python/object/apply:os.system [true]", "not valid YAML"),
        ("- 1", "must hold keys"),
        ("[" * 30_000, "nested too deeply"),
        ("seed: " + "9" * 6000, "not valid YAML|out of range"),
        ("seed: " + "9" * 400, "out of range"),
        ("truncation_m: " + "9" * 400, "must be a number"),
        ("seed: 2001-99-99", "not valid YAML"),
        ("? [1]\n: 2", "not valid YAML"),
        ("seed: !!int 'x'", "not valid YAML"),
        ("truncation_m: !!float 'x'", "not valid YAML"),
    ],
)
def test_hostile_files_are_refused(text, says, tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=says):
        load_config(path, Config())


def test_missing_file_and_unknown_preset():
    with pytest.raises(InputError, match="did you mean 'lite'"):
        load_preset("litte")
    with pytest.raises(InputError, match="no such preset"):
        load_preset("../lite")


def test_every_field_is_read_somewhere():
    """No setting that nothing reads."""
    from pathlib import Path

    modules = Path(config_files.__file__).parent.rglob("*.py")
    source = "".join(p.read_text() for p in modules if p.name not in ("config.py", "config_files.py"))

    def names(node):
        for f in dataclasses.fields(node):
            value = getattr(node, f.name)
            yield from names(value) if dataclasses.is_dataclass(value) else [f.name]

    unread = {n for n in names(Config()) if f".{n}" not in source}
    assert not unread
