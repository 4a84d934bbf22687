import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from filelock import FileLock

from pimper_torch.kernels.compile import (
    COARSE,
    GRADIENTS,
    PHOTOMETRY,
    ROWS,
    SFM,
    SURFACE,
    SWEEP,
    cache_folder,
    compiled,
    forget_unused,
    load,
    sources,
)
from pimper_torch.runtime.errors import PimperWarning

AHEAD = "from pimper_torch.kernels.compile import *; children = compile_ahead(); "


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """Give subprocesses of a test an empty kernel cache."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))


def started(code: str) -> "subprocess.Popen[str]":
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe, text=True)


def test_compiled_functions_agree_with_python():
    @compiled("float64(float64)")
    def halved(value: float) -> float:
        return value / 2

    assert halved(3.0) == 1.5


def test_loading_all_kernels_keeps_torch_threads_and_leaves_nothing_to_compile():
    code = (
        "import torch; torch.set_num_threads(2)\n"
        "from pimper_torch.kernels.compile import ROWS, _started, compile_ahead, load\n"
        "load(sum(ROWS, ())); assert torch.get_num_threads() == 2\n"
        "_started.cache_clear(); assert not compile_ahead(gradients=True)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_kernel_of_a_run_is_compiled():
    listed = [name for row in ROWS for name in row]
    assert sorted(listed) == sorted((*SFM, *COARSE, *PHOTOMETRY, *SWEEP, *SURFACE, *GRADIENTS))
    with_types = {
        path.stem
        for path in sources()
        if re.search(r'@compiled\(\s*(f?"|\*|annotated)', path.read_text())
    }
    assert with_types == {*listed, "lookup"}  # lookup is imported by other kernels


def test_a_run_waits_for_kernels_that_another_process_compiles(fresh):
    code = (
        "from pimper_torch.kernels.compile import cache_folder, load\n"
        "print(cache_folder(), flush=True); input(); load(('line_matches',))\n"
        "from pimper_torch.stages.sfm.kernels.line_matches import most_alike as kernel\n"
        "print(*kernel.stats.cache_hits.values())"
    )
    with started(code) as run:
        assert run.stdout is not None
        assert run.stdin is not None
        folder = run.stdout.readline().strip()
        with FileLock(f"{folder}/0.lock"):
            print(file=run.stdin, flush=True)
            time.sleep(2)
            assert run.poll() is None
        assert run.stdout.read() == "1\n"


@pytest.mark.skipif(sys.platform == "win32", reason="ends processes as POSIX does")
@pytest.mark.parametrize("end", ["sys.exit()", "os.kill(os.getpid(), 9)"])
def test_the_compiling_process_ends_with_its_parent(fresh, end):
    with started(
        f"import os, sys; {AHEAD} print(children[0].pid, flush=True); input(); {end}"
    ) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        os.kill(child, 0)
        parent.communicate("\n")
    for _ in range(100):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("it compiles on")


def test_kernels_are_compiled_after_the_compiling_process_died(fresh):
    code = (
        f"{AHEAD} [each.kill() for each in children]; load(('line_matches',))\n"
        "from pimper_torch.stages.sfm.kernels.line_matches import most_alike as kernel\n"
        "print(dict(kernel.stats.cache_misses))"
    )
    with started(code) as parent:
        output, _ = parent.communicate()
    assert output.strip().endswith(": 1}")


@pytest.mark.slow
def test_a_kernel_is_bitwise_reproducible_from_disk_and_in_any_order(fresh, tmp_path, monkeypatch):
    """The kernel calls many functions, some of which are shared with another kernel."""
    code = (
        "import numpy as np\n"
        "from pimper_torch.kernels.compile import load\n"
        "load(('lights_and_albedo',))\n"
        "from pimper_torch.lighting.kernels import lights_and_albedo as lights\n"
        "random, views, samples = np.random.default_rng(5), 7, 4 * lights.TILE\n"
        "normals = random.normal(size=(3, samples))\n"
        "normals /= np.linalg.norm(normals, axis=0)\n"
        "geometry = np.concatenate([np.ones((1, samples)), normals])\n"
        "seen = (random.random((views, samples)) > 0.2).astype(float)\n"
        "radiance = seen * random.random((views, samples))\n"
        "light, albedo = random.random((views, 4)), np.ones(samples)\n"
        "level = radiance.mean(axis=1)\n"
        "lights.fit(geometry, radiance, seen, level, 2.0, 30, 1e-9, light, albedo)\n"
        "misses = sum(lights.fit.stats.cache_misses.values())\n"
        "print(misses, light.tobytes().hex(), albedo.tobytes().hex())"
    )
    factorization = "import pimper_torch.stages.photometry.kernels.factorization\n"
    other = factorization + code.replace("load((", "print((")
    first, later = (subprocess.check_output([sys.executable, "-c", code]) for _ in range(2))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "another"))
    anew = subprocess.check_output([sys.executable, "-c", other])
    assert first.startswith(b"0 ")
    assert first == later
    assert anew.split()[-2:] == first.split()[-2:]


def test_an_unknown_kernel_is_an_error():
    with pytest.raises(ModuleNotFoundError):
        load(("no_such_kernel",))


def test_machine_code_is_found_by_the_hash_of_the_kernels(tmp_path, monkeypatch):
    """The folder depends neither on the path of the package nor on its time of installation."""
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "cache"))
    found = []
    for place, code in (("one", "pass"), ("two", "pass"), ("two", "pass  # edited")):
        kernels = tmp_path / place / "stage" / "kernels"
        kernels.mkdir(exist_ok=True, parents=True)
        (kernels / "kernel.py").write_text(code)
        monkeypatch.setattr("pimper_torch.kernels.__path__", [str(tmp_path / place / "kernels")])
        found.append(cache_folder.__wrapped__())
    assert found[0] == found[1] != found[2]
    assert {folder.parent for folder in found} == {tmp_path / "cache"}


@pytest.mark.skipif(sys.platform == "win32", reason="has no such modes")
def test_machine_code_is_only_read_from_folders_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr("pimper_torch.kernels.__path__", [str(tmp_path / "kernels")])
    folder = cache_folder.__wrapped__()
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o770)
    beside = cache_folder.__wrapped__()
    assert beside == tmp_path / "kernels" / "__pycache__" / folder.name
    beside.rmdir()
    beside.symlink_to(tmp_path)
    with pytest.warns(PimperWarning, match="compiled in every run. Set NUMBA_CACHE_DIR to"):
        temporary = cache_folder.__wrapped__()
    assert tmp_path not in temporary.parents


@pytest.mark.skipif(sys.platform == "win32", reason="has no such modes")
def test_a_complete_folder_is_used_without_write_permission(tmp_path, monkeypatch):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr("pimper_torch.kernels.__path__", [str(tmp_path / "kernels")])
    folder = cache_folder.__wrapped__()
    monkeypatch.setattr("os.access", lambda path, _: path != folder)
    assert cache_folder.__wrapped__() == tmp_path / "kernels" / "__pycache__" / folder.name
    for name in (name for row in ROWS for name in row):
        (folder / f"{name}.done").touch()
    assert cache_folder.__wrapped__() == folder


def test_without_a_home_the_folder_next_to_the_kernels_is_used(tmp_path, monkeypatch):
    def homeless() -> None:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr("numba.config.CACHE_DIR", "")
    monkeypatch.setattr("pimper_torch.kernels.compile.user_cache", homeless)
    monkeypatch.setattr("pimper_torch.kernels.__path__", [str(tmp_path / "kernels")])
    assert cache_folder.__wrapped__().parent == tmp_path / "kernels" / "__pycache__"


@pytest.mark.parametrize(
    "lock",
    [
        "OSError(errno.ENOLCK, 'No locks available')",  # network disks
        "OSError(errno.ENOTSUP, 'Operation not supported')",
        "NotImplementedError('no flock')",  # earlier versions of filelock
        "",  # held by a process that does not end
    ],
)
def test_kernels_are_compiled_for_later_runs_without_locks(lock, fresh):
    """The child then compiles without a lock; a finished kernel needs none."""
    refuse = f"def refuse(*_): raise {lock}\nfilelock.FileLock.acquire = refuse\n" if lock else ""
    code = (
        "import errno, filelock, pimper_torch.kernels.compile as c\n"
        f"{refuse}c.ROWS, c._PATIENCE_S = (('line_matches',),), 0.1\n"
        "print(c.cache_folder(), flush=True); input(); c._child(0)"
    )
    with started(code) as child:
        assert child.stdout is not None
        assert child.stdin is not None
        folder = child.stdout.readline().strip()
        with FileLock(f"{folder}/0.lock"):
            print(file=child.stdin, flush=True)
            assert child.wait(timeout=300) == 0
            loaded = (
                "from pimper_torch.stages.sfm.kernels.line_matches import most_alike as kernel\n"
                "print(*kernel.stats.cache_hits.values())"
            )
            assert subprocess.check_output([sys.executable, "-c", loaded]) == b"1\n"
    assert Path(folder, "line_matches.done").exists()


def test_a_long_wait_for_another_process_is_said(monkeypatch):
    class Waiting:
        states = iter([None, None, 1])

        def poll(self) -> int | None:
            return next(self.states)

    monkeypatch.setattr("pimper_torch.kernels.compile._PATIENCE_S", 0.0)
    monkeypatch.setattr("pimper_torch.kernels.compile.compile_ahead", lambda _: (Waiting(),))
    with pytest.warns(PimperWarning, match=r"not compiled yet.* delete the files \*\.lock there"):
        load(("json",))


def test_unused_folders_of_old_code_are_removed(tmp_path):
    long_ago = time.time() - 40 * 86_400
    for name, mode, used in (
        ("kernels-" + "0" * 32, 0o700, time.time()),
        ("kernels-" + "1" * 32, 0o755, long_ago),
        ("kernels-of-others", 0o700, long_ago),
        ("kernels-" + "2" * 32, 0o700, long_ago),
    ):
        (tmp_path / name).mkdir()
        (tmp_path / name).chmod(mode)
        os.utime(tmp_path / name, (used, used))
    forget_unused(tmp_path)
    assert sorted(path.name[-1] for path in tmp_path.iterdir()) == ["0", "1", "s"]
