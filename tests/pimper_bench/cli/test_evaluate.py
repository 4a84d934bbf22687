import json

import pytest
from PIL import Image
from scenes import write_ball

from pimper_bench.cli.evaluate import mesh_capture, named_as
from pimper_bench.metrics.estimates import Estimate
from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.chains.chain_config import CoarseToFineConfig
from pimper_torch.cli.main import main
from pimper_torch.export.results import write_result
from pimper_torch.io.meshes import read_mesh, write_ply


def run(*arguments):
    return main(["evaluate", *map(str, arguments)])


@pytest.fixture
def ball(tmp_path):
    return write_ball(tmp_path / "ball.ply", 1.0)


@pytest.fixture(scope="module")
def rendering(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered")
    config = SceneConfig(num_views=3, width=50, height=36, supersample=1)
    return render_scene(write_ball(folder / "ball.ply", 1.0), folder / "out", config, processes=1)


def test_a_mesh_is_measured_against_a_mesh(ball, tmp_path, capsys):
    larger = write_ball(tmp_path / "larger.ply", 1.1)
    assert run(larger, ball, "--samples", 3000) == 0
    printed, said = capsys.readouterr()
    assert "none: the frames are assumed to be the same" in printed
    assert "different frame: turned by 0 degrees, and 1.1 times as large" in " ".join(said.split())
    # Facets of a ball of 1280 faces lie a little under it.
    (line,) = [line for line in printed.splitlines() if line.split()[:1] == ["accuracy"]]
    assert float(line.split()[1]) == pytest.approx(0.1, rel=0.03)
    assert "rays" not in printed


@pytest.mark.usefixtures("small_pictures")
def test_the_prediction_error_of_a_result_is_reported(ball, reconstruction, tmp_path, capsys):
    write_result(reconstruction, CoarseToFineConfig(), tmp_path / "result")
    out = tmp_path / "report.json"
    assert run(tmp_path / "result", ball, "--samples", 3000, "-o", out) == 0
    printed = capsys.readouterr().out
    figures = json.loads(out.read_text())["relighting"]
    assert "photographs used" in printed
    assert f"{figures['psnr_db']:.2f} dB" in printed
    assert f"{figures['psnr_matte_db']:.2f} dB" in printed
    assert "mean over 3 photographs" in printed
    assert figures["materials"][0]["vertices"] == 1


def test_icp_is_reported_with_its_trimmed_fraction_and_removes_scale(ball, tmp_path, capsys):
    larger = write_ball(tmp_path / "larger.ply", 1.1)
    out = tmp_path / "report.json"
    options = ["--alignment", "icp", "--trimmed-fraction", 0.1]
    assert run(larger, ball, "--samples", 3000, *options, "-o", out) == 0
    printed = capsys.readouterr().out
    assert "similarity ICP, point to plane, 10 % of the estimate trimmed, from identity" in printed
    assert str(out) in printed
    report = json.loads(out.read_text())
    assert report["alignment"]["scale"] == pytest.approx(1 / 1.1, rel=5e-3)
    assert report["surface"]["accuracy"]["mean"] < 5e-3
    assert report["settings"]["alignment"] == "icp"
    assert report["truth"] == str(ball)


def test_the_true_mesh_of_a_rendered_scene_has_no_error(rendering, capsys):
    result = rendering / "truth" / "mesh.ply"
    assert run(result, rendering, "--samples", 3000, "--thresholds-percent", 0.1, 2) == 0
    printed = capsys.readouterr().out
    assert "f_score at 0.1 %" in printed
    assert "f_score at 2 %" in printed
    assert "along the rays of view_001.png" in printed  # the centre one
    assert "100.0 %" in printed
    assert "seen from 3 positions" in printed


def test_only_a_former_report_is_replaced_and_only_on_request(ball, tmp_path, capsys):
    mesh = read_mesh(ball)
    write_ply(mesh.replace(expected_error=0.05 * (2 + mesh.vertices_world[:, 2])), ball)
    out = tmp_path / "report.json"
    larger = write_ball(tmp_path / "larger.ply", 1.1)
    both = ["-o", out, "--samples"]
    assert run(ball, larger, *both, 3000) == 0
    first = out.read_bytes()
    capsys.readouterr()
    assert run(ball, larger, *both, 2000) == 2
    assert f"{out}: already exists" in capsys.readouterr().err
    assert out.read_bytes() == first
    assert run(ball, larger, *both, 2000, "--overwrite") == 0
    assert json.loads(out.read_text())["settings"]["samples"] == 2000

    mine = tmp_path / "mine.json"
    mine.write_text('{"thesis": "years of work"}')
    picture = tmp_path / "mine.png"
    Image.new("L", (3, 3)).save(picture)
    (tmp_path / "link").symlink_to(mine)
    for option, path in (
        ("-o", mine),
        ("-o", ball),
        ("-o", tmp_path / "link"),
        ("-o", picture),
        ("--report", out),
    ):
        before = path.read_bytes()
        assert run(ball, larger, option, path, "--overwrite") == 2
        assert "was not written by this command" in capsys.readouterr().err
        assert path.read_bytes() == before
    assert run(ball, larger, "-o", "/dev/null", "--overwrite") == 2
    assert "is not a regular file" in capsys.readouterr().err
    assert run(ball, larger, "-o", tmp_path / ("x" * 300)) == 2
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def test_a_full_disk_keeps_the_former_report(ball, tmp_path, capsys, monkeypatch):
    out = tmp_path / "report.json"
    assert run(ball, ball, "--samples", 500, "-o", out) == 0
    before = out.read_bytes()

    def full(path, *_, **__):
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(type(out), "write_text", full)
    assert run(ball, ball, "--samples", 600, "-o", out, "--overwrite") == 2
    assert "No space left on device" in capsys.readouterr().err
    assert out.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ball.ply", "report.json"]


def test_views_can_be_selected_by_name(rendering, tmp_path, capsys):
    result, out = rendering / "truth" / "mesh.ply", tmp_path / "report.json"
    views = ["--views", "view_000.png", "view_002"]
    assert run(result, rendering, "--samples", 3000, "-o", out, *views) == 0
    names = [view["name"] for view in json.loads(out.read_text())["views"]]
    assert names == ["view_000.png", "view_002.png"]
    capsys.readouterr()
    assert run(result, rendering, "--samples", 3000, "--views", "nobody") == 2
    assert "no view 'nobody'" in capsys.readouterr().err


def test_figures_have_their_meaning_next_to_them_if_it_fits(ball, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "200")
    assert run(ball, ball, "--samples", 500) == 0
    (wide,) = [line for line in capsys.readouterr().out.splitlines() if "chamfer_mean" in line]
    assert wide.endswith("mean of mean accuracy and mean completeness")
    monkeypatch.setenv("COLUMNS", "80")
    assert run(ball, ball, "--samples", 500) == 0
    (narrow,) = [line for line in capsys.readouterr().out.splitlines() if "chamfer_mean" in line]
    assert "mean of" not in narrow


def test_a_result_is_evaluated_by_the_protocol_of_dtu(dtu, tmp_path, capsys):
    result, out = write_ball(tmp_path / "result.ply", 10.5, level=4), tmp_path / "report.json"
    options = ["--truth-layout", "dtu-mvs", "--scan", 9, "--samples", 3000, "-o", out]
    assert run(result, dtu, *options) == 0
    report = json.loads(out.read_text())["dtu"]
    assert report["mean_completeness"] == pytest.approx(0.5, rel=0.1)
    assert report["overall"] == pytest.approx(
        (report["mean_accuracy"] + report["mean_completeness"]) / 2
    )
    assert "thinned to 0.2 mm" in capsys.readouterr().out


def test_views_of_a_set_are_paired_by_position_under_any_light(ball):
    names = ("rect_001_0_r5000.png", "rect_002_0_r5000.png", "rect_003_0_r5000.png")
    capture = mesh_capture(ball)
    capture = capture.replace(views=capture.views.replace(names=names))
    mine = ("rect_003_5_r5000.png", "rect_001_2_r5000.png", "rect_001_6_r5000.png")
    found = named_as(capture, Estimate(mesh=capture.truth.mesh, names=mine))
    assert found.views.names == (*names[:2], "rect_003_5_r5000.png")


@pytest.mark.parametrize(
    ("result", "truth", "options", "words"),
    [
        ("ball.ply", "ball.ply", ["--alignment", "cameras"], "needed: at least two"),
        ("ball.ply", "ball.ply", ["--trimmed-fraction", "1.5"], "trimmed_fraction is 1.5"),
        ("ball.ply", "ball.ply", ["-o", "."], "is not a regular file"),
        ("ball.ply", "ball.ply", ["-o", "nowhere/report.json"], "its folder does not exist"),
        ("ball.ply", "empty", [], "a folder without truth/; needed"),
        ("empty", "ball.ply", [], "contains no mesh.ply"),
        ("ball.ply", "away.ply", [], "away.ply: does not exist"),
        ("ball.ply", "empty", ["--truth-layout", "dtu-mvs"], "--scan with the number of one"),
    ],
)
def test_invalid_requests_give_one_message(
    ball, tmp_path, monkeypatch, capsys, result, truth, options, words
):
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path)
    assert run(result, truth, *options) == 2
    assert words in capsys.readouterr().err.replace("\n", " ")
