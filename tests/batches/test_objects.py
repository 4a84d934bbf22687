"""Objects of a folder, a pattern or a table."""

import pytest

from pimper_torch.cli.batches.objects import Object, read_objects
from pimper_torch.cli.batches.plan import planned_batch
from pimper_torch.runtime.errors import ConfigError, InputError


@pytest.fixture
def scans(world):
    for name in ("cup", "ball"):
        world.add(name)
    return world.folder / "scans"


def names(given):
    return [one.name for one in read_objects(given)]


def test_each_subfolder_is_an_object(scans):
    (scans / ".hidden").mkdir()
    (scans / "notes.txt").touch()
    (scans / "jar" / "photos").mkdir(parents=True)
    assert names(scans) == ["ball", "cup", "jar"]
    assert [one.photos.name for one in read_objects(str(scans))] == ["ball", "cup", "photos"]
    assert names([scans / "cup", str(scans / "jar"), Object(name="x", photos=scans)]) == [
        *("cup", "jar", "x")
    ]


def test_a_symbolic_link_keeps_its_name(scans):
    (scans / "bowl").symlink_to(scans / "cup")
    assert names(scans) == ["ball", "bowl", "cup"]
    assert names([scans / "bowl", scans / "bowl" / ".."]) == ["bowl", "scans"]


def test_the_name_in_a_table_overrides_that_of_the_folder(scans, tmp_path):
    (scans / ".raw").mkdir()
    table = tmp_path / "list.csv"
    table.write_text("photos,name\nscans/.raw,bowl\nscans/cup,\n")
    assert names(table) == ["bowl", "cup"]


def test_a_cell_of_several_values_is_split_as_by_a_shell(scans, tmp_path):
    table = tmp_path / "list.csv"
    table.write_text("photos;scale-bar;masks\nscans/cup;'a b.png,1,2' 1.png,3,4 25;my masks\n")
    (cup,) = read_objects(table)
    masks = str(tmp_path / "my masks")  # a single value is used verbatim
    assert cup.settings == ("--scale-bar", "a b.png,1,2", "1.png,3,4", "25", "--masks", masks)


def test_rows_of_a_table_have_settings(scans, tmp_path):
    (tmp_path / "mine.yaml").write_text("scales: [0.5]\n")
    table = tmp_path / "list.csv"
    table.write_text(
        "photos,name,preset,masks,faces,watertight,scale-bar,reconstruct.shared-camera\n"
        'scans/cup,mug,fast,scans/ball,500,yes,"0.png,1,2 1.png,3,4 25",no\n'
        "scans/ball,,mine.yaml,,,no,,TRUE\n"
    )
    mug, ball = read_objects(table)
    assert mug.settings == (
        *("--preset", "fast", "--masks", str(scans / "ball"), "--faces", "500", "--watertight"),
        *("--scale-bar", "0.png,1,2", "1.png,3,4", "25", "--reconstruct.no-shared-camera"),
    )
    assert ball.settings == (
        *("--preset", str(tmp_path / "mine.yaml"), "--reconstruct.shared-camera"),
    )
    assert (mug.name, ball.name) == ("mug", "ball")
    assert mug.photos == scans / "cup"
    assert ball.where == f"{table}, row 3"
    semicolons = tmp_path / "excel.csv"
    semicolons.write_bytes("\ufeffphotos;faces\r\nscans/cup;500\r\n".encode())
    assert read_objects(semicolons)[0].settings == ("--faces", "500")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name,faces\nx,2\n", "columns are name, faces; needed: `photos`"),
        ("photos,photos\nscans/cup,scans/cup\n", "each once"),
        ("", "its columns are none"),
        ("photos,view\nscans/cup,yes\n", "has the column view, which only `pimper batch`"),
        ("photos,faces\nscans/cup,5,6\n", "row 2: has more cells than there are columns (2)"),
        ("photos,faces\n,5\n", "row 2: `photos` is empty"),
        ("photos,name\nscans/cup,../cup\n", "row 2: the name is '../cup'"),
        ("photos,name\nscans/cup,.stages\n", "does not begin with a dot"),
        ("photos,name\nscans/cup,batch.csv\n", "row 2: the name is 'batch.csv'"),
        ("photos,name\nscans/cup,a\nscans/ball,A\n", "several objects have one name"),
        ("photos;scale-bar\nscans/cup;'a.png,1,2 b.png,3,4 5\n", "row 2: --scale-bar is 'a.png"),
        ("photos\n", "no objects; needed: a folder of folders"),
    ],
)
def test_an_invalid_table_is_refused(scans, tmp_path, text, message):
    table = tmp_path / "list.csv"
    table.write_text(text)
    with pytest.raises((InputError, ConfigError)) as refused:
        read_objects(table)
    assert message in str(refused.value)
    assert str(table) in str(refused.value)


@pytest.mark.parametrize("given", ["nowhere", "nowhere/*", "nowhere.csv"])
def test_a_list_without_objects_is_refused(tmp_path, given):
    with pytest.raises(InputError, match="nowhere"):
        read_objects(tmp_path / given)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("photos,fases\nscans/cup,5\n", "--fases"),
        ("photos,faces\nscans/cup,\nscans/ball,many\n", "row 3: --faces is 'many'"),
        ("photos,sweep.steps\nscans/cup,-3\n", "row 2: "),
        ("photos,watertight\nscans/cup,maybe\n", "row 2: "),
    ],
)
def test_a_wrong_setting_is_refused_with_its_row_before_the_first_run(world, scans, text, message):
    table = world.folder / "list.csv"
    table.write_text(text)
    with pytest.raises(ConfigError) as refused:
        planned_batch(read_objects(table), world.out)
    assert message in str(refused.value)
    assert f"{table}, row" in str(refused.value)
    assert not world.out.exists()


def test_settings_of_a_row_override_those_of_the_batch(world, scans):
    table = world.folder / "list.csv"
    table.write_text("photos,faces\nscans/cup,500\n")
    (task,) = planned_batch(read_objects(table), world.out, ("--faces", "9", "--stl"))
    given = ("--faces", "9", "--stl", "--faces", "500")
    # The working size is planned: it must not depend on the memory of runs next to it.
    assert task.arguments[4:] == (*given, "--max-size-px", "1600", "--json")
    (task,) = planned_batch(read_objects([scans / "cup"]), world.out, ("--max-size-px", "50"))
    assert task.arguments[4:] == ("--max-size-px", "50", "--json")
