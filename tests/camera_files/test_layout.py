import numpy as np
import pytest
import torch

from pimper_torch.doors.camera_files.layout import DataSetPath
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.numpy_files import read_npy, read_npz


def test_a_refusal_tells_where_what_was_needed_and_what_there_is(tmp_path):
    (tmp_path / "one.txt").touch()
    with pytest.raises(InputError, match=r"not the layout of a toy.*a spoon.*one\.txt") as refusal:
        DataSetPath(tmp_path, "a toy").expect(False, "a spoon")
    assert str(tmp_path) in str(refusal.value)


@pytest.mark.parametrize(
    "name", ["../x.png", "/etc/passwd", "a/../../x", "link/../../x.png", "..", "a\0b"]
)
def test_a_path_that_leads_out_of_the_folder_is_refused(tmp_path, name):
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    with pytest.raises(InputError, match="leads out of it"):
        DataSetPath(folder, "a toy").inside(name)
    assert DataSetPath(folder, "a toy").inside("a/../b.png").resolve() == folder / "b.png"


def test_links_in_the_folder_are_followed_and_not_left_by_dots(tmp_path):
    folder, elsewhere = tmp_path / "set", tmp_path / "far" / "photographs"
    folder.mkdir()
    elsewhere.mkdir(parents=True)
    (elsewhere / "x.png").touch()
    (elsewhere.parent / "secret.png").touch()
    (folder / "images").symlink_to(elsewhere)
    (folder / "one.png").symlink_to(elsewhere / "x.png")
    place = DataSetPath(folder, "a toy")
    assert place.inside("images/x.png").is_file()
    assert place.inside("one.png").is_file()
    # To the system, images/.. is the folder that the link's end lies in.
    assert (folder / "images" / ".." / "secret.png").is_file()
    assert not place.inside("images/../secret.png").exists()


@pytest.mark.parametrize("value", ["1 2.5 -3e1", ["1", "2.5", "-30"], [[1, 2.5, -30]]])
def test_numbers_come_as_texts_or_lists(tmp_path, value):
    expected = torch.tensor([1.0, 2.5, -30.0], dtype=torch.float64)
    assert torch.equal(DataSetPath(tmp_path, "a toy").numbers(value, 3, "x"), expected)


@pytest.mark.parametrize("value", [None, "1 2", [1, 2, "nan"], [[1], [2, 3]], {"a": 1}, [1, 2, {}]])
def test_anything_but_so_many_finite_numbers_is_refused(tmp_path, value):
    with pytest.raises(InputError, match="3 finite numbers as x"):
        DataSetPath(tmp_path, "a toy").numbers(value, 3, "x")


@pytest.mark.parametrize("text", ["", "[1, 2]", "{", "[" * 100000, "\ufeff3"])
def test_json_of_anything_but_an_object_is_refused(tmp_path, text):
    path = tmp_path / "a.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"a\.json"):
        DataSetPath(path, "a toy").read_json()


def test_a_file_that_is_no_text_is_refused(tmp_path):
    (tmp_path / "a.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="UTF-8"):
        DataSetPath(tmp_path / "a.json", "a toy").read_json()


@pytest.mark.parametrize("value", [None, [], "", [1], {"a": 1}])
def test_anything_but_a_list_of_objects_is_refused(tmp_path, value):
    with pytest.raises(InputError, match="a list of objects as frames"):
        DataSetPath(tmp_path, "a toy").objects(value, "frames")


def test_a_name_longer_than_file_systems_have_is_refused_shortly(tmp_path):
    with pytest.raises(InputError, match="names of files") as told:
        DataSetPath(tmp_path, "a set").inside("x" * 9000)
    assert len(str(told.value)) < 1000


@pytest.mark.parametrize("reader", [read_npy, read_npz])
@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut short"])
def test_whatever_a_reader_says_of_a_damaged_file_names_the_file(tmp_path, reader, content):
    (tmp_path / "a.np").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.np: cannot be read as arrays .*of a toy"):
        DataSetPath(tmp_path / "a.np", "a toy").read(reader, "arrays")
    with pytest.raises(InputError, match=r"a file b\.np.*Found: a\.np"):
        DataSetPath(tmp_path / "b.np", "a toy").read(reader, "arrays")


def test_pickles_are_not_opened(tmp_path):
    np.save(tmp_path / "a.npy", np.array([{"a": 1}]), allow_pickle=True)
    np.savez(tmp_path / "a.npz", a=np.array([{"a": 1}], dtype=object))
    for name, reader in (("a.npy", read_npy), ("a.npz", read_npz)):
        with pytest.raises(InputError, match="cannot be read"):
            DataSetPath(tmp_path / name, "a toy").read(reader, "arrays")
