"""Help and refusals come before torch is loaded, and are those of the command itself."""

import subprocess
import sys
from pathlib import Path

import pytest

from pimper_torch.cli.main import commands, main
from pimper_torch.cli.options import parse
from pimper_torch.runtime.config import to_mapping


def answers(code: str, folder: Path) -> str:
    """Run code in a process in which nothing is loaded, and return what it prints."""
    line = [sys.executable, "-c", code]
    ran = subprocess.run(line, capture_output=True, text=True, cwd=folder)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_the_help_that_comes_at_once_is_that_of_the_command(tmp_path, capsys):
    code = f"""if True:
        import sys
        from pimper_torch.cli.main import main
        for command in {[*commands()]}:
            try:
                main([command, "--help-all"])
            except SystemExit:
                assert "torch" not in sys.modules
                print("====")
    """
    *at_once, rest = answers(code, tmp_path).split("====\n")
    assert rest == ""
    for command, told in zip(commands(), at_once, strict=True):
        with pytest.raises(SystemExit):  # torch is loaded here
            main([command, "--help-all"])
        assert len(told) > 500
        assert told == capsys.readouterr().out


REFUSED = [
    ["reconstruct", "photos", "-o", "out", "--sede", "3"],
    ["reconstruct", "nowhere", "-o", "out"],
    ["reconstruct", "photos", "-o", "out", "--masks", "nowhere"],
    ["reconstruct", "photos", "-o", "out", "--reference", "nosuch"],
    ["demo", "--preset", "papr"],
    ["demo", "-o", "photos"],
    ["render", "mug", "-o", "out", "--num-views", "-3"],
    ["export", "nowhere", "-o", "out", "--format", "maps"],
    ["export", "photos", "-o", "out", "--format", "gif"],
    ["export", "photos", "-o", "photos", "--format", "maps"],
    ["evaluate", "nowhere", "photos"],
    ["convert", "nowhere", "-o", "out", "--source", "idr", "--target", "colmap"],
    ["gamma", "nowhere"],
    ["clean", "nowhere"],
]


def test_refusals_do_not_wait_for_torch(tmp_path):
    """Torch alone takes more than a second."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.png").write_bytes(b"")
    code = f"""if True:
        import sys
        from pimper_torch.cli.main import main
        for line in {REFUSED}:
            code = main(line)
            heavy = {{"torch", "numpy", "scipy", "pycolmap"}} & {{*sys.modules}}
            print("answered", code, *sorted(heavy), *line, file=sys.stderr)
    """
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    found = [line for line in ran.stderr.splitlines() if line.startswith("answered")]
    assert found == [f"answered 2 {' '.join(line)}" for line in REFUSED]


def test_settings_are_read_as_the_command_reads_them(tmp_path):
    line = ["photos", "-o", "out", "--preset", "fast", "--decompose.overlap-samples", "3"]
    line += ["--photographs.saturation", "1,2,3", "--factorize.min-views", "9"]
    line += ["--region", "(0,0,0,1,1,1)", "--reference", "a"]
    code = f"""if True:
        import sys
        from pimper_torch.cli.light import absent
        with absent():
            from pimper_torch.cli.options import parse
            from pimper_torch.runtime.config import to_mapping
            print(to_mapping(parse("reconstruct", {line}).config))
        assert "torch" not in sys.modules and "pimper_torch.cli.options" not in sys.modules
        import pimper_torch.cli
        assert not hasattr(pimper_torch.cli, "options")
    """
    assert answers(code, tmp_path).strip() == str(to_mapping(parse("reconstruct", line).config))


def test_what_takes_long_to_load_is_absent_and_stands_any_use(tmp_path):
    code = """if True:
        from pimper_torch.cli.light import ABSENT, absent
        with absent():
            import torch.nn.functional as F
            from pimper_torch.method.coarse.surface import CoarseSurface, CoarseSurfaceConfig
            from pimper_torch.runtime.errors import ConfigError
            assert F.some.thing(3)[4] | int is ABSENT
            assert issubclass(CoarseSurface, ABSENT)
            try:
                CoarseSurfaceConfig(num_facets=1)
            except ConfigError as error:
                print(error)
    """
    assert "num_facets" in answers(code, tmp_path)


def test_where_nothing_can_be_told_at_once_the_command_does(tmp_path):
    code = """if True:
        from pimper_torch.cli import light
        from pimper_torch.cli.main import main
        light._Finder.find_spec = None  # whatever goes wrong
        assert main(["gamma", "nowhere"]) == 2
        import torch
    """
    answers(code, tmp_path)


def test_whoever_has_read_enough_sees_no_traceback():
    code = """if True:
        import os, sys
        from pimper_torch.cli.main import main
        reading, writing = os.pipe()
        os.dup2(writing, 1)
        os.close(reading)
        sys.exit(main(["gamma", "--help"]))
    """
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stderr == ""
