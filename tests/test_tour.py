"""A new user's view of the package: names, help, completion."""

import pydoc
from inspect import ismodule

import jedi
import pytest

import pimper_torch as pt


def test_the_tour_is_one_screen():
    assert dir(pt) == sorted([*pt.__all__, "Encoding", "Given", "priors_of", "save_record"])
    assert len(pt.__all__) < 30
    assert len(pydoc.plain(pydoc.render_doc(pt))) < 20_000


def test_a_public_name_is_in_the_package_or_a_listed_subpackage():
    subpackages = [subpackage for name in pt.__all__ if ismodule(subpackage := getattr(pt, name))]
    for name in pt._names:
        value = getattr(pt, name)
        assert name in pt.__all__ or any(
            getattr(subpackage, name, None) is value for subpackage in subpackages
        ), name
    assert all(name in pt.__doc__ for name in pt.__all__ if ismodule(getattr(pt, name)))
    with pytest.raises(AttributeError, match="wrap"):
        _ = pt.wrap


@pytest.mark.parametrize(
    ("code", "offered"),
    [
        ('pt.load_chain("default")(pt.load_views("photos/")).', {"mesh", "scene", "report"}),
        ('pt.load_chain("default").', {"factorize", "sweep", "steps", "config"}),
        ('pt.CoarseToFine()(pt.load_views("photos/")).mesh.', {"vertices_world", "albedo"}),
        ('next(pt.Published().steps(pt.load_views("photos/"))).', {"photometric", "surface"}),
        ("pt.stages.", {"Warp", "Factorize", "Stage"}),
        ("pt.", {"load_record", "Encoding", "priors_of", "Given", "write_mesh"}),
        ("pt.priors.", {"from_onnx", "priors_of", "segment"}),
        ('pt.load_chain("paper").config.', {"triangulate", "align"}),
    ],
)
def test_completion_offers_existing_names(code, offered, tmp_path, monkeypatch):
    """Completion does not execute code; workers that share jedi's cache read half-written files."""
    monkeypatch.setattr(jedi.settings, "cache_directory", tmp_path)
    in_a_file = jedi.Script(f"import pimper_torch as pt\n{code}").complete()
    assert offered <= {one.name for one in in_a_file}
    in_a_cell = jedi.Interpreter(code, [{"pt": pt}]).complete()
    assert offered <= {one.name for one in in_a_cell}
