"""The package's code agrees with SECURITY.md."""

import ast
from functools import cache
from pathlib import Path

import pimper_bench
import pimper_torch

PACKAGES = [Path(package.__file__).parent for package in (pimper_torch, pimper_bench)]
UNPICKLE = {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal"}
NETWORK = {"socket", "urllib", "http", "ftplib", "requests", "httpx", "aiohttp", "ssl"}


@cache
def _found():
    """List imports and calls of all files, once and only on demand."""
    imports, calls = [], []
    for package, path in ((each, path) for each in PACKAGES for path in each.rglob("*.py")):
        name = path.relative_to(package).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imports += [(name, alias.name.partition(".")[0]) for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                imports.append((name, node.module.partition(".")[0]))
            elif isinstance(node, ast.Call):
                calls.append((name, ast.unparse(node.func), node))
    return imports, calls


def imports():
    return _found()[0]


def calls():
    return _found()[1]


def test_nothing_is_unpickled():
    assert not [found for found in imports() if found[1] in UNPICKLE]
    loads = [(path, node) for path, name, node in calls() if name in ("np.load", "numpy.load")]
    for path, node in loads:
        refused = {each.arg: ast.unparse(each.value) for each in node.keywords}
        assert refused.get("allow_pickle") == "False", path
    assert not [path for path, name, _ in calls() if name == "torch.load"]


def test_no_network_connection_is_made():
    found = {path for path, name in imports() if name in NETWORK}
    assert found == {"viewer/server.py"}  # checks whether an address is local


def test_no_text_is_evaluated_as_code():
    assert not [path for path, name, _ in calls() if name in ("eval", "exec", "compile")]
    assert not [path for path, name, _ in calls() if name in ("os.system", "yaml.unsafe_load")]
    loaders = {path for path, name, _ in calls() if name == "yaml.load"}
    assert loaders == {"runtime/config.py"}  # by a subclass of SafeLoader


def test_only_baselines_and_python_are_run_as_processes():
    assert {path for path, name in imports() if name in ("subprocess", "pty")} == {
        "stages/texturing/atlas.py",  # Python, which calls xatlas
        "cli/batches/task.py",  # Python, which is `pimper reconstruct`
        "baselines/openmvs.py",
        "kernels/compile.py",  # Python, which compiles its kernels
    }
