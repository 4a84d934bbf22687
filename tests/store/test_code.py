"""Which code a record depends on."""

import pytest

from pimper_torch.store import code
from pimper_torch.store.code import code_of


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package of five files: a imports b and, inside a function, c.inner; b imports a."""
    root = tmp_path / "pimper_torch"
    (root / "c").mkdir(parents=True)
    (root / "a.py").write_text(
        "from pimper_torch.b import (\n    x,\n    y,\n)\n"
        "\ndef f():\n    import pimper_torch.c.inner\n"
    )
    (root / "b.py").write_text("import pimper_torch.a\n")
    (root / "c" / "__init__.py").write_text("")
    (root / "c" / "inner.py").write_text("from pimper_torch import d\n")
    (root / "d.py").write_text("")
    (root / "alone.py").write_text("import os\n")
    monkeypatch.setattr(code, "_PACKAGE", root)
    code_of.cache_clear()
    yield root
    code_of.cache_clear()


@pytest.mark.parametrize("changed", ["a.py", "b.py", "c/inner.py", "d.py"])
def test_what_is_imported_counts(package, changed):
    before = code_of("pimper_torch.a")
    (package / changed).write_text((package / changed).read_text() + "# changed\n")
    code_of.cache_clear()
    assert code_of("pimper_torch.a") != before


def test_what_is_not_imported_does_not(package):
    before = code_of("pimper_torch.a"), code_of("pimper_torch.alone")
    (package / "alone.py").write_text("# changed\n")
    code_of.cache_clear()
    assert code_of("pimper_torch.a") == before[0]
    assert code_of("pimper_torch.alone") != before[1]


def test_versions_count(monkeypatch):
    code_of.cache_clear()
    before = code_of("pimper_torch.fusion.fuse")
    monkeypatch.setattr(code, "_versions", lambda: "torch 1")
    code_of.cache_clear()
    assert code_of("pimper_torch.fusion.fuse") != before
    code_of.cache_clear()


def test_other_code_is_not_known():
    assert code_of("torch.nn") is None
    assert code_of("pimper_torch") is None
    assert code_of("pimper_torch.nothing") is None
    assert code_of("pimper_torch_extra.fuse") is None


def test_versions_name_what_the_package_depends_on():
    assert "torch 2" in code._versions()
    assert "pycolmap 4" in code._versions()
