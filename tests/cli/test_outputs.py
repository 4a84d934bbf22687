"""Commands do not damage folders that already contain files."""

import threading

import pytest
from command_line import contents, run
from scenes import write_ball

from pimper_torch.export.result_folder.folders import held_output


@pytest.fixture
def project(tmp_path):
    """A user's folder with the same file names as a result."""
    folder = tmp_path / "proj"
    (folder / "sparse").mkdir(parents=True)
    (folder / "mesh.ply").write_text("a week of work")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        (folder / "sparse" / name).write_text("a model")
    return folder


@pytest.mark.parametrize("option", ["--sparse", "--mesh", "--masks", "--cache"])
def test_an_input_in_the_results_folder_is_refused(
    photos, chain, project, capsys, tmp_path, option
):
    before = contents(project)
    (tmp_path / "link").symlink_to(project)
    for place in (project, tmp_path / "link"):
        given = place / ("mesh.ply" if option == "--mesh" else "sparse")
        for flags in ([], ["--overwrite"]):
            assert run("reconstruct", photos, "-o", project, option, given, *flags) == 2
            assert f"{option} ({given}) is inside the result folder" in capsys.readouterr().err
    assert run("reconstruct", project, "-o", project, "--overwrite") == 2
    assert "PHOTOS" in capsys.readouterr().err
    assert contents(project) == before
    assert chain.given is None


def test_user_files_in_a_scene_folder_are_not_overwritten(tmp_path, capsys):
    write_ball(tmp_path / "ball.ply", level=1)
    small = ["--num-views", "2", "--width", "32", "--height", "24", "--processes", "1"]
    assert run("render", tmp_path / "ball.ply", "-o", tmp_path / "out", *small) == 0
    for part in ("photos", "masks"):
        mine = tmp_path / "out" / part / "mine.png"
        mine.write_text("mine")
        assert run("render", tmp_path / "ball.ply", "-o", tmp_path / "out", "--overwrite") == 2
        assert f"{part}/mine.png" in capsys.readouterr().err
        assert mine.read_text() == "mine"
        mine.unlink()
    mesh = tmp_path / "out" / "truth" / "mesh.ply"
    assert run("render", mesh, "-o", tmp_path / "out", "--overwrite") == 2
    assert "is inside the result folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("convert {own} -o {own} --source colmap --target idr", "DATA"),
        ("convert {other} -o {own} --images {own}/sparse --source colmap --target idr", "--images"),
        ("convert {other} -o {own} --mesh {own}/sparse --source colmap --target idr", "--mesh"),
        ("export {own} -o {own} --format maps", "RESULT"),
        ("export {other} -o {own} --photos {own}/sparse --format maps", "--photos"),
        ("bench -o {own} --cache {own}/sparse", "--cache"),
        ("bench -o {own} --methods {own}/mine.yaml", "mine.yaml"),
    ],
)
def test_inputs_inside_the_output_of_other_commands_are_refused(project, capsys, line, expected):
    (project / "mine.yaml").write_text("seed: 3\n")
    assert run(*line.format(own=project, other=project.parent).split(), "--overwrite") == 2
    message = capsys.readouterr().err
    assert expected in message
    assert "is inside the result folder" in message


@pytest.mark.parametrize("command", ["reconstruct", "demo", "render", "bench", "convert", "export"])
def test_a_folder_in_use_by_a_run_is_refused(photos, chain, tmp_path, capsys, command):
    """While a run has the lock of the folder, every command that writes there is refused."""
    kinds = {"render": "scene", "bench": "table", "convert": "data set", "export": "data set"}
    kind = kinds.get(command, "result")
    given = {
        "reconstruct": [photos],
        "render": ["mug"],
        "convert": [photos, "--source", "idr", "--target", "colmap"],
        "export": [photos, "--format", "maps"],
    }.get(command, [])
    codes = []
    with held_output(tmp_path / "out", kind):
        other = threading.Thread(
            target=lambda: codes.append(run(command, *given, "-o", tmp_path / "out"))
        )
        other.start()
        other.join()
    assert codes == [2]
    assert "another run is writing to it: process" in capsys.readouterr().err
    assert chain.given is None
    assert not (tmp_path / "out").exists()


def test_a_run_locks_its_folder_before_reading_photographs(photos, chain, tmp_path, monkeypatch):
    codes = []

    def meanwhile(self):
        monkeypatch.setattr(chain, "work", lambda self: None)
        codes.append(run("reconstruct", photos, "-o", tmp_path / "out"))

    def in_a_thread(self):
        other = threading.Thread(target=meanwhile, args=(self,))
        other.start()
        other.join()

    monkeypatch.setattr(chain, "work", in_a_thread)
    assert run("reconstruct", photos, "-o", tmp_path / "out") == 0
    assert codes == [2]
