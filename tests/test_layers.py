"""The house: imports point downwards, heavy libraries stay behind their seams, and the wheel holds what it should."""

import ast
import functools
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
LAYERS = (
    ("types", "messages", "config", "config_files", "strict_yaml"),
    ("rigid", "indices", "compiled", "atomic", "cores", "interrupts"),
    ("se3",),
    ("kernels", "provenance"),
    ("field",),
    (
        "datasets",
        "denoising",
        "earlier",
        "exposure",
        "movers",
        "pixels",
        "pixels_gpu",
        "shutter",
        "landmarks",
        "samples",
        "sending",
        "rays",
        "observed",
        "observed_gpu",
    ),
    ("descent", "volume", "volume_gpu", "scene_box"),
    ("keyframes", "window", "trajectory", "pixel_bank", "draws", "pose_adam", "field_adam", "views", "saving"),
    ("align", "tracker", "tracker_gpu"),
    (
        "mapper",
        "loops",
        "recovery",
        "relocalisation",
        "following",
        "meshing",
        "meshing_blocks",
        "meshing_table",
        "evaluation",
    ),
    ("beside",),
    ("slam",),
    ("selfcalibration", "cameras"),
    ("runtime",),
    ("bench",),
    ("reports",),
    ("commands",),
    ("camera_commands",),
    ("options",),
    ("bench_cli",),
    ("cli",),
    ("__main__",),
)
DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "tomllib": "tomli", "yaml": "pyyaml"}
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}
GROUND = {"types", "messages", "config", "strict_yaml", "indices", "compiled", "atomic", "cores", "interrupts"}


def module_name(path: Path) -> str:
    """``app/panels/view.py`` -> ``ecslam_app.panels.view``."""
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    parts[0] = {"app": "ecslam_app"}.get(parts[0], parts[0])
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_name(p): p for folder in ("ecslam", "app") for p in sorted((ROOT / folder).rglob("*.py"))}


@functools.cache
def imports(module: str, at_start_only: bool = False) -> frozenset[str]:
    """Absolute names of what a module imports, ``from x import y`` as x.y where that is a module of ours, else as x.

    Imports for the type checker alone do not count; at_start_only: nor do those inside functions.
    """
    path = MODULES[module]
    package = module if path.stem == "__init__" else module.rpartition(".")[0]
    found: set[str] = set()
    for node in statements(ast.parse(path.read_text("utf-8")), at_start_only):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.rsplit(".", node.level - 1)[0] if node.level > 1 else package
            base = ".".join(filter(None, (above if node.level else "", node.module)))
            full = {alias.name: f"{base}.{alias.name}" for alias in node.names}
            found |= {name if name in MODULES else base for name in full.values()}
    return frozenset(found)


def statements(tree: ast.AST, at_start_only: bool) -> list[ast.AST]:
    """The nodes below ``tree``, without ``if TYPE_CHECKING:`` and, where wanted, without the bodies of functions."""
    out: list[ast.AST] = []
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            continue
        out.append(node)
        if not (at_start_only and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)):
            out += statements(node, at_start_only)
    return out


def ours(module: str) -> str:
    """The layer's name of a module of ours: ``ecslam.kernels.cpu`` -> ``kernels``."""
    return module.split(".")[1]


def users_of(library: str) -> set[str]:
    return {m for m in MODULES if any(name.split(".")[0] == library for name in imports(m))}


def reached(module: str) -> set[str]:
    """Everything that importing a module imports, ours and other people's."""
    seen: set[str] = set()
    waiting = [module]
    while waiting:
        name = waiting.pop()
        if name not in seen:
            seen.add(name)
            parts = name.split(".")
            parents = [".".join(parts[:i]) for i in range(1, len(parts))]
            waiting += [*parents, *(imports(name, at_start_only=True) if name in MODULES else ())]
    return seen


def test_every_module_has_a_layer():
    assert {ours(m) for m in MODULES if m.startswith("ecslam.")} <= RANK.keys()


@pytest.mark.parametrize("module", sorted(m for m in MODULES if m.startswith("ecslam.")))
def test_imports_point_downwards(module):
    for name in imports(module):
        if name.startswith("ecslam.") and ours(name) != ours(module):
            assert RANK[ours(name)] <= RANK[ours(module)], f"{module} imports {name} from a layer above it"


def test_no_two_modules_import_each_other():
    for module in MODULES:
        for name in imports(module, at_start_only=True) & MODULES.keys():
            assert module not in imports(name, at_start_only=True), f"{module} and {name}"


def test_the_command_starts_without_heavy_libraries():
    found = {name.split(".")[0] for name in reached("ecslam.commands")}
    assert {"numpy", "cv2"} <= found
    assert not found & {"torch", "scipy", "numba", "matplotlib", "trimesh", "viser", "ecslam_app"}


def test_datasets_import_the_ground_layer_only():
    for module in MODULES:
        if module.startswith("ecslam.datasets"):
            layers = {ours(name) for name in imports(module) if name.startswith("ecslam.")}
            assert layers <= GROUND | {"datasets"}, module


def test_the_dashboard_imports_contracts_and_file_formats_only():
    for module in MODULES:
        if module.startswith("ecslam_app"):
            found = {name for name in imports(module) if name.split(".")[0] == "ecslam"}
            found -= {"ecslam.datasets.meshes", "ecslam.evaluation.trajectory_io"}
            assert {ours(name) for name in found} <= {"messages", "config", "config_files", "types", "runtime"}, module


@pytest.mark.parametrize(
    "module", ["ecslam_app.server", "ecslam.runtime.protocol", "ecslam.runtime.feed", "ecslam.cli"]
)
def test_torch_is_not_imported_for(module):
    assert "torch" not in reached(module)
    assert "torch" in reached("ecslam.slam")


@pytest.mark.parametrize("library", ["viser", "trimesh"])
def test_a_headless_engine_starts_without(library):
    assert library not in reached("ecslam.commands") | reached("ecslam.runtime.engine") | reached("ecslam.slam")


def test_a_port_is_found_busy_without_viser():
    assert "viser" not in reached("ecslam_app.listen")
    assert "viser" in reached("ecslam_app.server")


def test_heavy_libraries_stay_behind_their_seams():
    assert all(m.startswith("ecslam_app") for m in users_of("viser"))
    for library in ("numba", "triton", "llvmlite"):
        assert all(m.startswith(("ecslam.kernels.", "ecslam.datasets.synthetic.")) for m in users_of(library))
    assert users_of("open3d") == {"ecslam.bench.peer"}
    assert users_of("numba")
    assert users_of("viser")


def third_party(roots: set[str]) -> set[str]:
    """The distributions that bring these top-level modules, without Python's own and ours."""
    own = {"ecslam", "ecslam_app", "tests", *(path.stem for path in Path(__file__).parent.glob("*.py"))}
    return {DISTRIBUTIONS.get(name, name) for name in roots - sys.stdlib_module_names - own}


def declared(*extras: str) -> set[str]:
    """The distributions that pyproject.toml asks for: always, and with these extras."""
    project = PYPROJECT["project"]
    asked = sum((project["optional-dependencies"][name] for name in extras), project["dependencies"])
    return {re.split(r"[^\w-]", requirement)[0] for requirement in asked}


def test_pyproject_declares_what_is_imported_and_nothing_else():
    imported = third_party({name.split(".")[0] for module in MODULES for name in imports(module)})
    assert declared() <= imported <= declared("oracles", "peer")


def test_pyproject_declares_what_tests_import():
    trees = [ast.parse(path.read_text("utf-8")) for path in Path(__file__).parent.glob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and not node.level}
    assert third_party({name.split(".")[0] for name in names}) <= declared("dev", "oracles")


def test_pyproject_lists_every_package():
    listed = set(PYPROJECT["tool"]["setuptools"]["packages"])
    folders = {m for m, path in MODULES.items() if path.name == "__init__.py"}
    assert listed == folders | {"ecslam.configs"}
    assert {p.parent for p in MODULES.values()} == {MODULES[m].parent for m in folders}


@pytest.mark.slow
def test_the_wheel_holds_the_presets_and_owns_no_bare_name(tmp_path):
    pytest.importorskip("setuptools", "77")
    source = tmp_path / "source"
    source.mkdir()
    for name in ("ecslam", "app", "configs", "pyproject.toml", "README.md", "LICENSE"):
        subprocess.run(["cp", "-r", str(ROOT / name), str(source)], check=True)
    options = ["--no-deps", "--no-build-isolation", "--quiet", "--wheel-dir", str(tmp_path)]
    subprocess.run([sys.executable, "-m", "pip", "wheel", *options, str(source)], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {f"ecslam/{p.relative_to(ROOT)}" for p in (ROOT / "configs").rglob("*.yaml")} <= names
    assert {m.replace(".", "/") + ".py" for m, p in MODULES.items() if p.name != "__init__.py"} <= names
    top = {name.split("/")[0] for name in names}
    assert {name for name in top if not name.endswith(".dist-info")} == {"ecslam", "ecslam_app"}
