"""Commands of other distributions are found, listed in the help, and reported if missing."""

from importlib.metadata import EntryPoint
from itertools import pairwise

import pytest
import yaml

from pimper_torch.cli import main as module
from pimper_torch.cli.main import OF_BENCH, commands, main
from pimper_torch.presets.load_config import load_config
from pimper_torch.runtime.config import presets, to_mapping

GROUP = "pimper.commands"


def offer(monkeypatch, *entries, installed=None):
    """Simulate distributions that offer commands, with or without ``pimper_bench``."""
    made = [EntryPoint(name, module, GROUP) for name, module in entries]
    monkeypatch.setattr(module, "entry_points", lambda group: made if group == GROUP else [])
    monkeypatch.setattr(module, "find_spec", lambda _: installed)


def helped(capsys):
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    return {line.split()[0]: line for line in printed.splitlines() if line.startswith("  ")}


@pytest.mark.parametrize("name", OF_BENCH)
def test_a_missing_distribution_is_named(name, capsys, monkeypatch):
    offer(monkeypatch)
    assert main([name, "mug"]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"error: `pimper {name}` comes with pimper-bench")
    assert "`pip install ./benchmarks`" in message
    assert message.count("\n") == 1
    assert name not in helped(capsys)


def test_the_help_lists_the_available_commands(capsys, monkeypatch):
    usual = helped(capsys)
    assert {*OF_BENCH} < {*usual}
    offer(monkeypatch, ("render", "pimper_bench.cli.render_command"), ("stroke", "brushes.cli"))
    found = helped(capsys)
    assert {*usual} - {*found} == {"evaluate", "bench", "convert"}
    assert {*found} - {*usual} == {"stroke"}
    assert found["stroke"].endswith("provided by brushes")
    assert found["render"] == usual["render"]
    assert [*found][-1] == "stroke"


def test_commands_work_from_a_checkout_and_installed_ones_take_precedence(monkeypatch):
    offer(monkeypatch, installed="there")
    assert OF_BENCH.items() <= commands().items()
    offer(monkeypatch, ("render", "brushes.cli"), installed="there")
    assert (OF_BENCH | {"render": "brushes.cli"}).items() <= commands().items()


def test_a_command_of_a_different_distribution_is_run(tmp_path, capsys, monkeypatch):
    (tmp_path / "brushes.py").write_text(
        "def checked(command, arguments):\n    return [command, *arguments]\n"
        "def run(job, output):\n    print(*job)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    offer(monkeypatch, ("stroke", "brushes"))
    assert main(["stroke", "wide"]) == 0
    assert capsys.readouterr().out == "stroke wide\n"


@pytest.mark.parametrize("preset", presets())
def test_the_output_is_the_preset_with_a_comment_on_each_setting(preset, tmp_path, capsys):
    assert main(["config", preset]) == 0
    text = capsys.readouterr().out
    (tmp_path / "mine.yaml").write_text(text)
    assert load_config(tmp_path / "mine.yaml") == load_config(preset)
    lines = text.splitlines()
    for before, line in pairwise(lines):
        assert line.lstrip().startswith("#") or not line or before.lstrip().startswith("# ")


def test_a_single_section_is_printed(capsys):
    assert main(["config", "sweep", "--preset", "default"]) == 0
    printed = yaml.safe_load(capsys.readouterr().out)
    assert printed == {"sweep": to_mapping(load_config("default").sweep)}


def test_a_setting_is_described(capsys):
    assert main(["config", "reconstruct.shared-camera"]) == 0
    printed = capsys.readouterr().out
    names = "--reconstruct.shared-camera, --reconstruct.no-shared-camera"
    assert printed.startswith(f"# option: {names}\n")
    assert "All photographs share one lens" in printed
    assert yaml.safe_load(printed) == {"reconstruct": {"shared_camera": False}}


@pytest.mark.parametrize(
    ("name", "near"), [("steps", "sweep.steps"), ("swep", "sweep"), ("defualt", "default")]
)
def test_an_unknown_name_is_refused_with_a_suggestion(name, near, capsys):
    assert main(["config", name]) == 2
    assert f"Did you mean `{near}`?" in capsys.readouterr().err
