import pytest
from command_line import contents, run


def test_each_format_has_a_folder_with_its_name(folder, tmp_path, capsys):
    out = tmp_path / "more"
    assert run("export", folder, "-o", out, "--format", "rti", "maps", "rti") == 0
    assert {path.name for path in out.iterdir()} == {".pimper.json", "rti", "maps"}
    assert f"{out / 'maps'} is the result as maps" in capsys.readouterr().out


def test_a_former_export_is_replaced_unless_there_are_other_files(folder, tmp_path, capsys):
    out = tmp_path / "more"
    assert run("export", folder, "-o", out, "--format", "maps") == 0
    before = contents(out)
    assert run("export", folder, "-o", out, "--format", "rti") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert contents(out) == before
    assert run("export", folder, "-o", out, "--format", "rti", "--overwrite") == 0
    assert {path.name for path in out.iterdir()} == {".pimper.json", "rti"}
    (out / "rti" / "mine.txt").write_text("mine")
    assert run("export", folder, "-o", out, "--format", "maps", "--overwrite") == 2
    assert "rti/mine.txt" in capsys.readouterr().err


@pytest.mark.parametrize("format", ["colmap", "nerfstudio", "alicevision"])
def test_formats_with_photographs_need_them(folder, photographs, tmp_path, capsys, format):
    moved = photographs.rename(tmp_path / "moved")
    out = tmp_path / "more"
    assert run("export", folder, "-o", out, "--format", "maps", format) == 2
    assert "Give their folder with `--photos DIR`" in capsys.readouterr().err
    assert not out.exists()
    assert run("export", folder, "-o", out, "--format", format, "--photos", moved) == 0


def test_formats_without_photographs_do_not_need_them(folder, photographs, tmp_path):
    formats = ("--format", "maps", "rti", "nerfstudio")
    assert run("export", folder, "-o", tmp_path / "with", *formats) == 0
    photographs.rename(tmp_path / "moved")
    assert run("export", folder, "-o", tmp_path / "without", *formats[:3]) == 0
    for name in ("maps", "rti"):
        assert contents(tmp_path / "without" / name) == contents(tmp_path / "with" / name)


@pytest.mark.parametrize("inside", [".", "more", "../link/more"])
def test_an_export_into_the_result_itself_is_refused(folder, tmp_path, capsys, inside):
    (tmp_path / "link").symlink_to(folder)
    before = contents(folder)
    assert run("export", folder, "-o", folder / inside, "--format", "maps", "--overwrite") == 2
    assert "RESULT (" in capsys.readouterr().err
    assert contents(folder) == before


@pytest.mark.parametrize(("formats", "needed"), [(["gif"], "colmap"), ([], "one or more formats")])
def test_unknown_formats_are_refused(folder, tmp_path, capsys, formats, needed):
    assert run("export", folder, "-o", tmp_path / "more", "--format", *formats) == 2
    assert needed in capsys.readouterr().err
