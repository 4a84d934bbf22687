import json
import shutil

import pytest
import torch
from scenes import write_ball

import pimper_torch as pt
from pimper_bench.scenes import render_random
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


@pytest.mark.slow
def test_scenes_of_seeds_are_rendered_once_and_read_as_captures(tmp_path, capsys):
    out, tiny = tmp_path / "out", ["--num-views", "3", "--width", "48", "--height", "36"]
    assert main(["render", "random", "-o", str(out), "--seeds", "4:6", *tiny]) == 0
    assert "2 scenes of 3 photographs; 2 were rendered now" in capsys.readouterr().out
    captures = pt.data.Captures(out)
    assert [folder.name for folder in captures.folders] == ["random_000004", "random_000005"]
    assert torch.equal(captures[1].views.images, small_random(5).views.images)
    files = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    (out / "random_000005" / ".pimper.json").unlink()  # as of a run that was killed
    shutil.rmtree(out / "random_000005")
    assert main(["render", "random", "-o", str(out), "--seeds", "4:6", *tiny]) == 0
    assert "; 1 were rendered now" in capsys.readouterr().out
    again = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert again.keys() == files.keys()
    changed = {path.relative_to(out).parts[0] for path in files if again[path] != files[path]}
    assert changed == {"random_000005"}
    assert main(["render", "random", "-o", str(out), "--seeds", "5:7", *tiny[:4]]) == 2
    assert "random_000005: was rendered with height 36; needed: 1200" in capsys.readouterr().err
    assert not (out / "random_000006").exists()


def small_random(seed):
    return render_random(seed, num_views=3, width=48, height=36)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--seeds", "5"], "--seeds is '5'; needed: FIRST:END, such as 0:100"),
        (["--seeds", "5:5"], "--seeds is '5:5'; needed"),
        (["--seeds", "0:2", "--seed", "3"], "--seed is 3; needed: --seeds or --seed"),
        (["--bits", "16", "--path", "turntable"], "scene random: got path, bits; needed"),
        ([], "scene random: got num_views 2; needed: at least 3 views"),
    ],
)
def test_impossible_seeds_and_settings_of_random_scenes_are_refused(
    tmp_path, capsys, options, message
):
    assert render("random", tmp_path / "out", *options) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()
