"""Commands of other distributions are found, listed in the help, and reported if missing."""

from importlib.metadata import EntryPoint

import pytest

from pimper_torch.cli import main as module
from pimper_torch.cli.main import OF_BENCH, commands, main

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
