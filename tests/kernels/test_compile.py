import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from filelock import FileLock

import pimper_torch.ground.kernels
from pimper_torch.ground.kernels.compile import (
    COARSE,
    GRADIENTS,
    PHOTOMETRY,
    SFM,
    SURFACE,
    SWEEP,
    compiled,
    forget_stale,
    load,
)

AHEAD = "from pimper_torch.ground.kernels.compile import *; child = compile_ahead(); "


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """No kernel is compiled in the processes that a test starts."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))


def started(code: str) -> "subprocess.Popen[str]":
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, "-c", code], stdin=pipe, stdout=pipe, text=True)


def test_compiled_functions_answer_as_python_does():
    @compiled("float64(float64)")
    def halved(value: float) -> float:
        return value / 2

    assert halved(3.0) == 1.5


def test_compile_all_leaves_torchs_threads_alone_and_compile_ahead_nothing_to_do():
    code = (
        "import torch; torch.set_num_threads(2)\n"
        "from pimper_torch.ground.kernels.compile import compile_ahead, compile_all\n"
        "compile_all(); assert torch.get_num_threads() == 2; assert compile_ahead() is None"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_kernel_of_a_run_is_compiled():
    listed = {*SFM, *COARSE, *PHOTOMETRY, *SWEEP, *SURFACE}
    sources = Path(pimper_torch.ground.kernels.__path__[0]).glob("*.py")
    with_types = {
        path.stem
        for path in sources
        if re.search(r'@compiled\(\s*(f?"|\*|annotated)', path.read_text())
    }
    assert with_types == {*listed, *GRADIENTS, "lookup"}  # which other kernels import


def test_no_kernel_is_compiled_twice_at_once(fresh):
    """What another process compiles comes last, and is waited for."""
    code = (
        "from pimper_torch.ground.kernels.compile import cache_folder, load\n"
        "from pimper_torch.runtime.progress import listening\n"
        "print(cache_folder(), flush=True); input()\n"
        "with listening(lambda done, total: print(done, flush=True)):\n"
        "    load(('line_matches', 'lookup'))"
    )
    with started(code) as other:
        assert other.stdout is not None
        assert other.stdin is not None
        folder = other.stdout.readline().strip()
        with FileLock(f"{folder}/line_matches.lock"):
            print(file=other.stdin, flush=True)
            assert [other.stdout.readline() for _ in range(2)] == ["0\n", "1\n"]
            time.sleep(0.4)
            assert other.poll() is None
        assert other.stdout.read() == "2\n"
        assert other.wait() == 0


@pytest.mark.skipif(sys.platform == "win32", reason="ends processes as POSIX does")
@pytest.mark.parametrize("end", ["sys.exit()", "os.kill(os.getpid(), 9)"])
def test_the_compiling_process_ends_with_its_parent(fresh, end):
    with started(f"import os, sys; {AHEAD} print(child.pid, flush=True); input(); {end}") as parent:
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


def test_kernels_are_compiled_where_the_compiling_process_died(fresh):
    code = (
        f"{AHEAD} child.kill(); child.wait(); load(('line_matches',))\n"
        "from pimper_torch.ground.kernels.line_matches import most_alike as kernel\n"
        "print(dict(kernel.stats.cache_misses))"
    )
    with started(code) as parent:
        output, _ = parent.communicate()
    assert output.strip().endswith(": 1}")


@pytest.mark.slow
def test_a_kernel_gives_the_same_bits_compiled_and_from_disk(fresh):
    """The kernel calls many functions: its machine code has their copies, optimized again."""
    code = (
        "import numpy as np\n"
        "from pimper_torch.ground.kernels import lights_and_albedo as lights\n"
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
    runs = [subprocess.check_output([sys.executable, "-c", code], text=True) for _ in range(2)]
    (first, *compiled_bits), (later, *loaded_bits) = (run.split() for run in runs)
    assert (first, later) == ("1", "0")
    assert compiled_bits == loaded_bits


def test_an_unknown_kernel_is_an_error():
    with pytest.raises(ModuleNotFoundError):
        load(("no_such_kernel",))


def test_kernels_are_compiled_anew_when_any_of_their_sources_changed(tmp_path, monkeypatch):
    monkeypatch.setattr("pimper_torch.ground.kernels.__path__", [str(tmp_path)])
    kept = tmp_path / "__pycache__" / "one.py311.nbi"
    kept.parent.mkdir()
    for source in ("one.py", "two.py"):
        (tmp_path / source).touch()
        os.utime(tmp_path / source, (100, 100))
    kept.touch()
    os.utime(kept, (200, 200))
    forget_stale(kept.parent)
    assert kept.exists()
    os.utime(tmp_path / "two.py", (300, 300))
    forget_stale(kept.parent)
    assert not kept.exists()
