import ast
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import pimper_bench
import pimper_torch
from pimper_torch.cli.main import OF_BENCH
from pimper_torch.runtime.later import later

PACKAGE = Path(pimper_torch.__file__).parent
BENCH = Path(pimper_bench.__file__).parent
ROOT = Path(__file__).parents[1]

# A folder imports only itself and folders before it; a stage no other stage.
FOLDERS = [
    *("runtime", "records", "store", "radiometry", "kernels", "geometry", "linalg", "lighting"),
    "losses",
    *("scale", "io", "priors", "stages", "chains", "paper", "presets", "single_view", "viz"),
    *("export", "data", "viewer", "cli"),
]

SOLE_IMPORTERS = {
    "pycolmap": {"geometry/colmap_library.py"},
    "embreex": {"geometry/visibility.py"},
    "xatlas": {"stages/texturing/charts.py"},
    "fcpw": {"geometry/nearest.py"},
    "tifffile": {"io/decode.py"},
    "cv2": {
        "geometry/opencv.py",
        "io/decode.py",
        "scale/aruco.py",
        "cli/video/choose.py",
    },
    "av": {"cli/video/read.py"},
    "numba": {"kernels/compile.py"},
    "yaml": {"runtime/config.py"},
    "tyro": {"cli/", "pimper_bench/cli/"},
    "matplotlib": {"viz/", "pimper_bench/table/contact_sheet.py"},
    "viser": {"viewer/"},
    "onnxruntime": {"priors/network.py"},
    "rembg": {"priors/salient_networks.py"},
    "distributed": {"cli/batches/engines.py"},
    "submitit": {"cli/batches/engines.py"},
}

# Modules with a different name than their distribution.
MODULES = {
    "pyyaml": "yaml",
    "pillow": "PIL",
    "scikit-image": "skimage",
    "opencv-python-headless": "cv2",
}


def files() -> list[Path]:
    found = [path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py"]
    assert len(found) > 30
    return sorted(found)


def files_of_both() -> list[Path]:
    found = sorted(BENCH.rglob("*.py"))
    assert len(found) > 30
    return [*files(), *found]


def named(path: Path) -> str:
    """Return a file's path within this package, or with its package for the other one."""
    inside = path.is_relative_to(PACKAGE)
    return path.relative_to(PACKAGE if inside else BENCH.parent).as_posix()


@cache
def imports(path: Path) -> frozenset[str]:
    """Return all modules that a file imports, including imports inside functions."""
    return frozenset(_imports(path))


def _imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield str(node.module)


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_folders_import_only_folders_before_them(path):
    folder, inner, *_ = (*path.relative_to(PACKAGE).parts, "")
    allowed = FOLDERS[: FOLDERS.index(folder) + 1] if path.parent != PACKAGE else FOLDERS
    for module in imports(path):
        package, head, inside, *_ = (*module.split("."), "", "")
        assert package != "pimper_bench", "that is another distribution, which imports this one"
        if package == "pimper_torch":
            assert head, f"{path.name} imports the package as a whole"
            assert head in allowed, module
            if (folder, head) == ("stages", "stages") and path.name != "__init__.py":
                assert inside in {inner, "stage"}, module


def calls_of(function: str) -> Iterator[tuple[Path, str]]:
    for path in files():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(function):
                yield path, ast.unparse(node.args[0])


def test_only_methods_that_users_call_reach_later_folders_by_name():
    reached = {(named(path), ast.literal_eval(name)) for path, name in calls_of("later")}
    assert reached == {
        ("records/scene.py", "io.meshes.write_mesh"),
        ("records/scene.py", "io.meshes.trimesh_of"),
        ("records/record.py", "viz.cells.cell"),
        ("records/reconstruction.py", "viz.overview.overview"),
    }
    assert all(callable(later(name)) for _, name in reached)
    by_name = {named(path) for path, _ in calls_of("import_module")}
    assert by_name == {
        *("runtime/later.py", "runtime/former_modules.py", "kernels/compile.py"),
        *("io/extras.py", "cli/main.py"),
    }


# Functions that every command has, and entry points.
PROTOCOL = {"checked", "run", "main"}

# Compiled functions with the name of the function in torch that they are the twin of.
TWINS = {
    *("coarser", "congruence", "prolongation", "robust_variance", "tangent_step"),
    *("update_shading", "project_to_cone"),
}


def test_a_name_of_a_public_function_means_one_thing():
    homes = defaultdict(set)
    for path in files():
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
                homes[node.name].add(named(path))
    doubled = {name: found for name, found in homes.items() if len(found) > 1}
    assert doubled.keys() <= PROTOCOL | TWINS, doubled
    assert all(sum("kernels/" in home for home in homes[name]) == 1 for name in TWINS)


@pytest.mark.parametrize("package", SOLE_IMPORTERS)
def test_a_boundary_is_crossed_in_one_place(package):
    owners = SOLE_IMPORTERS[package]
    found = {
        named(path)
        for path in files_of_both()
        if any(module.split(".")[0] == package for module in imports(path))
    }
    assert found
    assert all(any(path.startswith(owner) for owner in owners) for path in found), found


def test_least_squares_are_reproducible_bit_for_bit():
    """LAPACK's gelsy, the default, gives other bits at every call."""
    calls = [
        (path, ast.unparse(node))
        for path in files_of_both()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("lstsq")
    ]
    assert calls
    assert all("driver='gelsd'" in call for _, call in calls), calls


def project(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("package", [PACKAGE, BENCH], ids=lambda package: package.name)
def test_every_imported_package_is_declared(package):
    declaring = project(ROOT if package == PACKAGE else ROOT / "benchmarks")
    extras = declaring.get("optional-dependencies", {})
    needed = [entry for name in extras for entry in extras[name] if name not in ("test", "docs")]
    needed += declaring["dependencies"]
    names = [re.split(r"[<>=\[ ]", entry)[0].lower() for entry in needed]
    declared = {MODULES.get(name, name.replace("-", "_")) for name in names}
    own = [path for path in files_of_both() if path.is_relative_to(package)]
    used = {module.split(".")[0] for path in own for module in imports(path)}
    assert used - set(sys.stdlib_module_names) - {package.name} <= declared


def test_distributions_changelog_and_citation_have_one_version():
    version = project(ROOT)["version"]
    headings = re.findall(r"^## (.+)$", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)
    assert next(one for one in headings if one != "Unreleased").startswith(f"[{version}] - ")
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
    assert project(ROOT / "benchmarks")["version"] == version
    assert f"pimper_torch=={version}" in project(ROOT / "benchmarks")["dependencies"]


def test_commands_without_installation_match_the_installed_ones():
    assert project(ROOT / "benchmarks")["entry-points"]["pimper.commands"] == OF_BENCH


def loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*{{name.split('.')[0] for name in sys.modules}})"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(ran.stdout.split())


def test_importing_the_package_loads_neither_colmap_nor_matplotlib():
    loaded = loaded_by("import pimper_torch; pimper_torch.load_chain, pimper_torch.load_views")
    assert "torch" in loaded  # or the test is void
    assert not loaded & {"pycolmap", "matplotlib", "tyro", "rich"}
