import numpy as np
import pytest
import torch

from pimper_bench.datasets.posed import file_in
from pimper_torch.io.cameras.layout import DataSetPath
from pimper_torch.runtime.errors import InputError
from pimper_torch.runtime.numpy_files import read_npy, read_npz

OUT = ("../x.png", "/etc/passwd", "a/../../x", "link/../../x.png", "..", "a\0b")


@pytest.fixture
def toy(tmp_path):
    (tmp_path / "one.txt").touch()
    (tmp_path / "link").symlink_to(tmp_path.parent)
    return DataSetPath(tmp_path, "a toy")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda toy: toy.expect(False, "a spoon"), r"not the layout of a toy.*a spoon.*one\.txt"),
        (lambda toy: file_in(toy.path, ("b.txt", "c.txt"), "a toy"), r"a file b\.txt or c\.txt"),
        (lambda toy: toy.inside("x" * 9000), "file names of at most 255 bytes"),
        *((lambda toy, name=name: toy.inside(name), "leads out of it") for name in OUT),
        *(
            (lambda toy, value=value: toy.numbers(value, 3, "x"), "3 finite numbers as x")
            for value in (None, "1 2", [1, 2, "nan"], [[1], [2, 3]], {"a": 1}, [1, 2, {}])
        ),
        *(
            (lambda toy, value=value: toy.objects(value, "y"), "a list of objects as y")
            for value in (None, [], "", [1], {"a": 1})
        ),
    ],
)
def test_invalid_values_are_refused_with_a_short_message(toy, call, message):
    with pytest.raises(InputError, match=message) as refusal:
        call(toy)
    assert str(toy.path) in str(refusal.value)
    assert len(str(refusal.value)) < 1000


def test_links_are_followed_and_dots_do_not_leave_the_folder(tmp_path):
    folder, elsewhere = tmp_path / "set", tmp_path / "far" / "photographs"
    folder.mkdir()
    elsewhere.mkdir(parents=True)
    (elsewhere / "x.png").touch()
    (elsewhere.parent / "secret.png").touch()
    (folder / "images").symlink_to(elsewhere)
    place = DataSetPath(folder, "a toy")
    assert place.inside("images/x.png").is_file()
    assert place.inside("a/../b.png").resolve() == folder / "b.png"
    # For the system, images/.. is the parent of the link's target.
    assert (folder / "images" / ".." / "secret.png").is_file()
    assert not place.inside("images/../secret.png").exists()


@pytest.mark.parametrize("value", ["1 2.5 -3e1", ["1", "2.5", "-30"], [[1, 2.5, -30]]])
def test_numbers_are_read_from_texts_or_lists(toy, value):
    expected = torch.tensor([1.0, 2.5, -30.0], dtype=torch.float64)
    assert torch.equal(toy.numbers(value, 3, "x"), expected)


@pytest.mark.parametrize("content", [b"", b"[1, 2]", b"{", b"[" * 100_000, b"\xff\xfe\x00"])
def test_json_of_anything_but_an_object_is_refused(toy, content):
    (toy.path / "a.json").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.json.*(JSON|UTF-8)"):
        toy.inner("a.json").read_json()


@pytest.mark.parametrize("reader", [read_npy, read_npz])
@pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut short", "pickle"])
def test_errors_of_readers_name_the_damaged_file(toy, reader, content):
    path = toy.path / ("a.npy" if reader is read_npy else "a.npz")
    if content == "pickle":
        save = np.save if reader is read_npy else np.savez
        save(path, np.array([{"a": 1}], dtype=object))
    else:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.np.: cannot be read as arrays .*of a toy"):
        toy.inner(path.name).read(reader, "arrays")
    with pytest.raises(InputError, match=r"a file b\.np.*Found: a\.np"):
        toy.inner("b.np").read(reader, "arrays")
