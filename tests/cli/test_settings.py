"""``pimper config`` prints a file of settings with a comment on each."""

from itertools import pairwise

import pytest
import yaml

from pimper_torch.cli.main import main
from pimper_torch.presets.load_config import load_config
from pimper_torch.runtime.config import presets, to_mapping


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
