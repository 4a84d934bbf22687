import json

import pytest
from scenes import write_ball

from pimper_torch.cli.main import main


@pytest.fixture
def ball(tmp_path):
    return write_ball(tmp_path / "ball.ply", level=2)


def render(scene, out, *options):
    small = ["--num-views", "2", "--width", "32", "--height", "24", "--processes", "1"]
    return main(["render", str(scene), "-o", str(out), *small, *options])


def test_a_scene_is_rendered_with_the_options_given(ball, tmp_path, capsys):
    options = ("-v", "--path", "turntable", "--bits", "16", "--encoding", "linear", "--seed", "4")
    assert render(ball, tmp_path / "out", *options) == 0
    settings = json.loads((tmp_path / "out" / "truth" / "scene.json").read_text())["settings"]
    assert settings["path"] == "turntable"
    assert settings["bits"] == 16
    assert settings["seed"] == 4
    assert settings["point_light_distance"] == 2.5
    printed = capsys.readouterr()
    assert f"{tmp_path}/out/photos" in printed.out
    assert "--photographs.response linear" in printed.out
    assert "photographs 2" in printed.err


def test_mutually_exclusive_settings_give_one_message(ball, tmp_path, capsys):
    assert render(ball, tmp_path / "out", "--fixed-point-light") == 2
    assert "fixed_point_light is True; needed: path turntable" in capsys.readouterr().err
