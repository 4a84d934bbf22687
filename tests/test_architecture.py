import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pytest

import pimper_bench
import pimper_torch
from pimper_torch.cli.main import OF_BENCH

PACKAGE = Path(pimper_torch.__file__).parent
BENCH = Path(pimper_bench.__file__).parent
ROOT = Path(__file__).parents[1]

# A subpackage imports from those above it in this list. The last line has the optional ones: the
# command line names their verbs, and imports one when it is called. viz is above io, which draws
# the contact sheet of a result with it.
SUBPACKAGES = [
    *("journal", "errors", "renamed", "mapped", "config", "progress", "cores", "file_names"),
    *("user_cache", "scratch"),
    *("numpy_files", "shapes", "kernels", "radiometry", "records", "ledger", "failures"),
    *("parallel", "stage", "store", "geometry", "memory", "linalg", "camera_files", "sfm"),
    *("silhouettes", "coarse", "patches", "photometry", "sweep", "fusion", "published", "meshing"),
    *("scale", "reporting", "priors", "viz", "asset", "relighting", "chains", "stages"),
    *("report", "result_folder", "io", "export", "prior_files", "viewer", "doctor", "video", "cli"),
    *("batches", "single_view", "__main__"),
]

LAYERS = {"runtime", "ground", "method", "priors", "result", "doors", "cli"}

# The method: no step imports from another step.
STEPS = {"sfm", "silhouettes", "coarse", "patches", "photometry", "sweep", "fusion", "meshing"}

SOLE_IMPORTERS = {
    "pycolmap": {"ground/geometry/colmap_library.py"},
    "embreex": {"ground/geometry/visibility.py"},
    "xatlas": {"result/asset/charts.py"},
    "fcpw": {"ground/geometry/nearest.py"},
    "tifffile": {"doors/io/decode.py"},
    "cv2": {
        "ground/geometry/opencv.py",
        "doors/io/decode.py",
        "doors/scale/aruco.py",
        "cli/video/choose.py",
    },
    "av": {"cli/video/read.py"},
    "numba": {"ground/kernels/compile.py"},
    "yaml": {"runtime/config.py"},
    "tyro": {"cli/", "cli/batches/", "pimper_bench/cli/", "single_view/cli/"},
    "matplotlib": {"result/viz/", "pimper_bench/bench/contact_sheet.py"},
    "viser": {"result/viewer/"},
    "pxr": {"result/asset/usd.py"},
    "onnxruntime": {"priors/network.py"},
    "distributed": {"cli/batches/engines.py"},
    "submitit": {"cli/batches/engines.py"},
}

# Modules with a different name than their distribution.
MODULES = {
    "pyyaml": "yaml",
    "pillow": "PIL",
    "usd-core": "pxr",
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


def subpackage(parts: Sequence[str]) -> str:
    """Return the subpackage of a file or module, inside a layer or at the top."""
    first, second, *_ = (*parts, "")
    return second if first in LAYERS and second in SUBPACKAGES else first


def subpackage_of(path: Path) -> str:
    return subpackage(path.relative_to(PACKAGE).with_suffix("").parts)


@pytest.mark.parametrize("path", files(), ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_only_upward(path):
    assert subpackage_of(path) in {*SUBPACKAGES, *LAYERS}, (
        f"{subpackage_of(path)} has no place in the layout"
    )
    if subpackage_of(path) not in SUBPACKAGES:
        assert path.name == "__init__.py"
        return
    for module in imports(path):
        head, _, rest = module.partition(".")
        assert head != "pimper_bench", "that is another distribution, which imports this one"
        if head == "pimper_torch":
            assert rest, f"{path.name} imports the package as a whole"
            other = subpackage(rest.split("."))
            assert SUBPACKAGES.index(other) <= SUBPACKAGES.index(subpackage_of(path)), module
            assert not {other, subpackage_of(path)} <= STEPS or other == subpackage_of(path), module


def test_the_top_folder_has_few_entries():
    sources = (path for path in PACKAGE.rglob("*") if path.is_file() and path.suffix != ".pyc")
    found = {path.relative_to(PACKAGE).parts[0] for path in sources} - {"__pycache__", "configs"}
    assert len(found) <= 16, sorted(found)


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
    assert len(calls) > 1
    assert all("driver='gelsd'" in call for _, call in calls), calls


def project(folder: Path) -> dict[str, Any]:
    return tomllib.loads((folder / "pyproject.toml").read_text())["project"]


@pytest.mark.parametrize("package", [PACKAGE, BENCH], ids=lambda package: package.name)
def test_every_imported_package_is_declared(package):
    declaring = project(ROOT if package == PACKAGE else ROOT / "bench")
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
    assert project(ROOT / "bench")["version"] == version
    assert f"pimper_torch=={version}" in project(ROOT / "bench")["dependencies"]


def test_commands_without_installation_match_the_installed_ones():
    assert project(ROOT / "bench")["entry-points"]["pimper.commands"] == OF_BENCH


def loaded_by(statement: str) -> set[str]:
    code = f"import sys; {statement}; print(*{{name.split('.')[0] for name in sys.modules}})"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(ran.stdout.split())


def test_importing_the_package_loads_neither_colmap_nor_matplotlib():
    loaded = loaded_by("import pimper_torch; pimper_torch.load_chain, pimper_torch.load_views")
    assert "torch" in loaded  # or the test is void
    assert not loaded & {"pycolmap", "matplotlib", "tyro", "rich"}
