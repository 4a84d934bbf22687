import pytest

from pimper_torch.cli.main import main


def run(*arguments):
    return main([str(argument) for argument in arguments])


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.*")}


def test_each_format_has_a_folder_of_its_name(folder, tmp_path, capsys):
    out = tmp_path / "more"
    assert run("export", folder, "-o", out, "--format", "lights", "maps", "lights") == 0
    assert {path.name for path in out.iterdir()} == {".pimper.json", "lights", "maps"}
    assert f"{out / 'maps'} is the result as maps" in capsys.readouterr().out


def test_a_former_export_is_replaced_if_nothing_else_is_there(folder, tmp_path, capsys):
    out = tmp_path / "more"
    assert run("export", folder, "-o", out, "--format", "maps") == 0
    before = contents(out)
    assert run("export", folder, "-o", out, "--format", "lights") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert contents(out) == before
    assert run("export", folder, "-o", out, "--format", "lights", "--overwrite") == 0
    assert {path.name for path in out.iterdir()} == {".pimper.json", "lights"}
    (out / "lights" / "mine.txt").write_text("mine")
    assert run("export", folder, "-o", out, "--format", "maps", "--overwrite") == 2
    assert "lights/mine.txt" in capsys.readouterr().err


def test_where_photographs_moved_nothing_is_written(folder, photographs, tmp_path, capsys):
    moved = photographs.rename(tmp_path / "moved")
    out = tmp_path / "more"
    assert run("export", folder, "-o", out, "--format", "maps") == 2
    assert "Name their folder by `--photos DIR`" in capsys.readouterr().err
    assert not out.exists()
    assert run("export", folder, "-o", out, "--format", "maps", "--photos", moved) == 0


@pytest.mark.parametrize(("formats", "needed"), [(["gif"], "colmap"), ([], "one format or more")])
def test_formats_that_there_are_not_are_refused(folder, tmp_path, capsys, formats, needed):
    assert run("export", folder, "-o", tmp_path / "more", "--format", *formats) == 2
    assert needed in capsys.readouterr().err
