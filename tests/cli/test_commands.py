"""Commands of other distributions are found, named in the help, and missed in a sentence."""

from importlib.metadata import EntryPoint

import pytest

from pimper_torch.cli import main as module
from pimper_torch.cli.main import OF_BENCH, commands, main

GROUP = "pimper.commands"


def offer(monkeypatch, *entries, installed=None):
    """Let distributions offer commands, and ``pimper_bench`` be there or not."""
    made = [EntryPoint(name, module, GROUP) for name, module in entries]
    monkeypatch.setattr(module, "entry_points", lambda group: made if group == GROUP else [])
    monkeypatch.setattr(module, "find_spec", lambda _: installed)


def helped(capsys):
    assert main(["--help"]) == 0
    told = capsys.readouterr().out
    return {line.split()[0]: line for line in told.splitlines() if line.startswith("  ")}


@pytest.mark.parametrize("name", OF_BENCH)
def test_without_the_distribution_a_sentence_says_so(name, capsys, monkeypatch):
    offer(monkeypatch)
    assert main([name, "mug"]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"error: `pimper {name}` comes with pimper-bench")
    assert "`pip install ./bench`" in message
    assert message.count("\n") == 1
    assert name not in helped(capsys)


def test_the_help_names_what_is_there(capsys, monkeypatch):
    usual = helped(capsys)
    assert {*OF_BENCH} < {*usual}
    offer(monkeypatch, ("render", "pimper_bench.cli.render_command"), ("stroke", "brushes.cli"))
    found = helped(capsys)
    assert {*usual} - {*found} == {"evaluate", "bench", "convert"}
    assert {*found} - {*usual} == {"stroke"}
    assert found["stroke"].endswith("brought by brushes")
    assert found["render"] == usual["render"]
    assert [*found][-1] == "stroke"


def test_a_checkout_serves_without_being_installed_and_what_is_installed_comes_first(monkeypatch):
    offer(monkeypatch, installed="there")
    assert OF_BENCH.items() <= commands().items()
    offer(monkeypatch, ("render", "brushes.cli"), installed="there")
    assert (OF_BENCH | {"render": "brushes.cli"}).items() <= commands().items()


def test_a_command_of_another_distribution_is_carried_out(tmp_path, capsys, monkeypatch):
    (tmp_path / "brushes.py").write_text(
        "def checked(command, arguments):\n    return [command, *arguments]\n"
        "def run(job, output):\n    print(*job)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    offer(monkeypatch, ("stroke", "brushes"))
    assert main(["stroke", "wide"]) == 0
    assert capsys.readouterr().out == "stroke wide\n"
