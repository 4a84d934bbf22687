"""Names of the previous version work for one more, with a warning that gives the new name."""

import pytest
import torch
from probes import small_scene

import pimper_torch as pt
from pimper_torch.single_view import factorization
from pimper_torch.stages.photometry import Bilinear, Cone


@pytest.mark.parametrize(
    ("old", "new"),
    [("size", "scale"), ("exchange", "export"), ("settled", "resolve_prior_conventions")],
)
def test_former_names_of_the_package_work_with_a_warning(old, new):
    with pytest.warns(DeprecationWarning, match=f"`pimper_torch.{old}` is now `{new}`"):
        assert getattr(pt, old) is getattr(pt, new)


def test_a_former_manifold_is_found_with_a_warning():
    with pytest.warns(DeprecationWarning, match="`Free` is now `FreeManifold`"):
        assert factorization.Free is factorization.FreeManifold


def test_a_former_name_of_a_record_works_with_a_warning():
    with pytest.warns(DeprecationWarning, match="`Lens` is now `CameraModel`"):
        assert pt.records.Lens is pt.records.CameraModel
    with pytest.raises(AttributeError, match="has no attribute 'Lense'"):
        pt.records.Lense  # noqa: B018


def test_former_names_of_fields_work_in_constructor_and_attribute():
    lights = torch.rand(1, 3, 4)
    fields = {"radiance": torch.rand(1, 3, 5), "weight": torch.ones(1, 3, 5), "lights": lights}
    fields |= {"shading": torch.rand(1, 4, 5), "regularization": torch.ones(1, 3)}
    with pytest.warns(DeprecationWarning, match="`anchor` is now `prior_mean`") as caught:
        problem = Bilinear(**fields, manifold=Cone(), anchor=lights)
    assert caught[0].filename == __file__  # the line that has to change
    with pytest.warns(DeprecationWarning, match="`anchor` is now `prior_mean`"):
        assert problem.anchor is problem.prior_mean is lights


def test_a_scene_reads_former_fields():
    scene, _ = small_scene(num_views=4, width=32, num_points=12)
    with pytest.warns(DeprecationWarning, match="`doubt` is now `diagnosis`"):
        assert scene.doubt == scene.diagnosis
