"""The code on which a record depends."""

import sys

import pytest

from pimper_torch.store.digest import code, is_known

# The package's attribute of this name is the function, not the module.
module = sys.modules[code.__module__]


@pytest.fixture(autouse=True)
def forgotten():
    code.cache_clear()
    yield
    code.cache_clear()


def test_the_hash_covers_source_files_their_names_and_versions(tmp_path, monkeypatch):
    (tmp_path / "pimper_torch" / "inner").mkdir(parents=True)
    monkeypatch.setattr(module, "_PACKAGE", tmp_path / "pimper_torch")
    seen = {code()}
    for name, text in (("a.py", ""), ("a.py", "x"), ("inner/b.py", "x"), ("inner/a.py", "x")):
        (tmp_path / "pimper_torch" / name).write_text(text)
        code.cache_clear()
        seen.add(code())
    monkeypatch.setattr(module, "version", lambda name: "another" if name == "torch" else "1")
    code.cache_clear()
    assert len(seen | {code()}) == 6


def test_code_outside_the_package_has_no_hash():
    assert is_known("pimper_torch.stages.fusion.fuse")
    assert not any(map(is_known, ["torch.nn", "pimper_torch_extra.fuse", "__main__"]))
