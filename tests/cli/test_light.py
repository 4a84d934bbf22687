"""Help and refusals come before torch is loaded, and are those of the command itself."""

import subprocess
import sys
from importlib import import_module

import pytest

from pimper_torch.chains.coarse_to_fine import CoarseToFineConfig
from pimper_torch.cli import light as light_module
from pimper_torch.cli.light import ABSENT, light
from pimper_torch.cli.main import _COMMANDS, _READERS, main
from pimper_torch.config import to_mapping
from pimper_torch.errors import ConfigError


def reader(command):
    return _READERS.get(_COMMANDS[command], _COMMANDS[command])


def told(checked, command, capsys):
    with pytest.raises(SystemExit):
        checked(command, ["--help"])
    return capsys.readouterr().out


@pytest.mark.parametrize("command", _COMMANDS)
def test_the_help_that_comes_at_once_is_that_of_the_command(command, capsys):
    home = reader(command)
    at_once = told(light(home, "checked"), command, capsys)
    assert len(at_once) > 500
    assert at_once == told(import_module(home).checked, command, capsys)


REFUSED = [
    ["reconstruct", "photos", "-o", "out", "--sede", "3"],
    ["reconstruct", "photos", "-o", "out", "--reconstruct.starts", "many"],
    ["reconstruct", "photos", "-o", "out", "--reconstruct.starts", "-1"],
    ["reconstruct", "nowhere", "-o", "out"],
    ["reconstruct", "empty", "-o", "out"],
    ["reconstruct", "photos", "-o", "out", "--masks", "nowhere"],
    ["reconstruct", "photos", "-o", "out", "--factorize.solver", "none"],
    ["reconstruct", "photos", "-o", "out", "--reference", "nosuch"],
    ["reconstruct", "photos", "-o", "out", "--max-size-px", "1"],
    ["demo", "--preset", "papr"],
    ["demo", "-o", "photos"],
    ["render", "mug", "-o", "out", "--num-views", "-3"],
    ["export", "nowhere", "-o", "out", "--format", "maps"],
    ["export", "photos", "-o", "out", "--format", "gif"],
    ["export", "photos", "-o", "out", "--format"],
    ["export", "photos", "-o", "photos", "--format", "maps"],
    ["evaluate", "nowhere", "photos"],
    ["evaluate", "photos", "photos", "-o", "photos"],
    ["bench", "-o", "photos"],
    ["convert", "nowhere", "-o", "out", "--source", "idr", "--target", "colmap"],
    ["gamma", "nowhere"],
    ["clean", "photos"],
    ["clean", "nowhere"],
    ["gamma", "photos", "--mask", "nowhere"],
]


def test_help_and_refusals_do_not_wait_for_torch(tmp_path):
    """Torch alone takes more than a second."""
    (tmp_path / "photos").mkdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "photos" / "a.png").write_bytes(b"")
    code = f"""if True:
        import sys
        from pimper_torch.cli.main import main
        lines = {[*REFUSED, *([command, "--help"] for command in _COMMANDS)]}
        for line in lines:
            try:
                code = main(line)
            except SystemExit as ended:
                code = ended.code
            heavy = {{"torch", "numpy", "scipy", "pycolmap"}} & {{*sys.modules}}
            print("answered", code, *sorted(heavy), *line, file=sys.stderr)
    """
    ran = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    found = [line for line in ran.stderr.splitlines() if line.startswith("answered")]
    wanted = [f"answered 2 {' '.join(line)}" for line in REFUSED]
    assert found == wanted + [f"answered 0 {command} --help" for command in _COMMANDS]


def test_settings_are_read_as_the_command_reads_them():
    line = ["photos", "-o", "out", "--preset", "fast", "--decompose.overlap-samples", "3"]
    line += ["--photographs.saturation", "1,2,3", "--factorize.min-views", "9"]
    line += ["--region", "(0,0,0,1,1,1)", "--reference", "a"]
    options = "pimper_torch.cli.options"
    found = light(options, "parse")("reconstruct", line)
    job = import_module(options).parse("reconstruct", line)
    assert to_mapping(found.config) == to_mapping(job.config)
    assert type(found.config) is not CoarseToFineConfig


def test_what_takes_long_to_load_is_absent_and_stands_any_use():
    assert light("pimper_torch.coarse.surface", "torch") is ABSENT
    assert light("pimper_torch.coarse.surface", "CoarseSurface") is ABSENT  # a module of torch's
    assert light("pimper_torch.coarse.surface", "CoarseSurfaceConfig") is not ABSENT
    assert light("pimper_torch.coarse.surface", "require") is not ABSENT
    assert ABSENT.some.thing(3)[4] | int is ABSENT
    assert 3 in ABSENT
    with pytest.raises(ConfigError, match="num_facets"):
        light("pimper_torch.coarse.surface", "CoarseSurfaceConfig")(num_facets=1)


def test_where_nothing_can_be_told_at_once_the_command_does(monkeypatch, capsys):
    def broken(*_):
        raise RuntimeError("not understood")

    monkeypatch.setattr(light_module, "light", broken)
    assert main(["gamma", "nowhere"]) == 2
    assert "nowhere: found nothing" in capsys.readouterr().err


@pytest.mark.parametrize("line", [["--help"], ["gamma", "--help"]])
def test_whoever_has_read_enough_sees_no_traceback(line):
    code = f"""if True:
        import os, sys
        from pimper_torch.cli.main import main
        reading, writing = os.pipe()
        os.dup2(writing, 1)
        os.close(reading)
        sys.exit(main({line}))
    """
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stderr == ""
