import os
import subprocess
import sys

import torch

from pimper_torch.kernels.switch import compile_all, compiled, compiled_for, forget_stale, using


def test_kernels_stand_in_only_without_gradients_and_where_chosen():
    values, asked = torch.ones(2), torch.ones(2, requires_grad=True)
    assert compiled_for(values)
    assert not compiled_for(values, asked)
    with torch.no_grad():
        assert compiled_for(values, asked)
    with using("torch"):
        assert not compiled_for(values)
    assert compiled_for(values)
    assert not compiled_for(torch.ones(2, device="meta"))


def test_compiled_functions_answer_as_python_does():
    @compiled("float64(float64)")
    def halved(value: float) -> float:
        return value / 2

    assert halved(3.0) == 1.5


def test_compiling_leaves_torchs_threads_alone():
    compile_all()
    code = (
        "import torch; torch.set_num_threads(2)\n"
        "from pimper_torch.kernels.switch import compile_all\n"
        "compile_all(); assert torch.get_num_threads() == 2"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_kernels_are_compiled_anew_when_any_of_their_sources_changed(tmp_path, monkeypatch):
    monkeypatch.setattr("pimper_torch.kernels.__path__", [str(tmp_path)])
    kept = tmp_path / "__pycache__" / "one.py311.nbi"
    kept.parent.mkdir()
    for source in ("one.py", "two.py"):
        (tmp_path / source).touch()
        os.utime(tmp_path / source, (100, 100))
    kept.touch()
    os.utime(kept, (200, 200))
    forget_stale()
    assert kept.exists()
    os.utime(tmp_path / "two.py", (300, 300))
    forget_stale()
    assert not kept.exists()
