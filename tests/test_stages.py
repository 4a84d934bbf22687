"""Errors of a custom stage are reported where its record enters the next stage."""

import pytest
import torch
from probes import small_scene
from solved import solved
from torch import nn

import pimper_torch as pt
from pimper_torch.stages.stage import Given

# Some of the few patches have too few lit views.
pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")


@pytest.fixture(scope="module")
def factorized():
    scene, coarse = small_scene(num_views=5, width=48)
    patches = pt.Decompose()(coarse, scene.cameras)
    seen = pt.Warp()(scene.views, scene.cameras, patches)
    return scene, seen, solved(pt.Factorize(), seen)


def chain_on(scene, coarse):
    everything = Given(pt.Silhouettes.everything(scene.views))
    return pt.load_chain(
        "default", {"scales": [1.0]}, silhouettes=everything, coarse_surface=Given(coarse)
    )


def changed(found, **changes):
    """Replace fields of the first bucket."""
    first, *rest = found.buckets
    new = {name: change(getattr(first, name)) for name, change in changes.items()}
    return found.replace(buckets=(first.replace(**new), *rest))


def opengl(normals):
    return normals * torch.tensor([1.0, -1, -1]).to(normals)


def spoilt(normals):
    return torch.where(torch.arange(len(normals))[:, None, None, None] == 0, torch.nan, normals)


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (lambda found: None, "photometric is NoneType; needed: PhotometricPatches"),
        (lambda found: found.patches, "photometric is PatchSet; needed: PhotometricPatches"),
        (lambda found: found.replace(buckets=()), "buckets has 0 entries; needed: one for each of"),
        (
            lambda found: found.replace(buckets=found.buckets[::-1]),
            r"buckets\[0\] has patches, height, width .*like its templates",
        ),
        (
            lambda found: changed(found, normals_patch=lambda n: n.float()),
            r"buckets\[0\].normals_patch is of torch.float32; needed: torch.float64",
        ),
        (
            lambda found: changed(found, normals_patch=spoilt),
            r"normals_patch has .*some with NaN",
        ),
        (lambda found: changed(found, normals_patch=lambda n: 2 * n), "of length 2 to 2"),
        (
            lambda found: changed(found, normals_patch=lambda n: 0.5 + 0.5 * opengl(n)),
            "look like colours from 0 to 1: decode them as 2 n - 1",
        ),
        (
            lambda found: changed(found, normals_patch=opengl),
            "they look like OpenGL's, with y up and z to the viewer: negate both",
        ),
        (lambda found: changed(found, information=lambda i: -1 - i), "outside .0, inf., such as -"),
    ],
)
def test_errors_of_a_custom_factorization_are_named(factorized, mistake, message):
    scene, seen, found = factorized
    with pytest.raises(pt.InputError, match=f"Sweep: .*{message}"):
        pt.Sweep()(scene.views, scene.cameras, seen, mistake(found))


def test_in_a_chain_the_message_names_the_receiving_stage():
    scene, coarse = small_scene(num_views=5, width=48)
    chain = chain_on(scene, coarse)
    chain.factorize = Given(None)
    with pytest.raises(pt.InputError, match=r"Sweep: photometric is NoneType.*the stage before"):
        chain(scene)


def test_records_of_stages_are_valid_and_checked_once(factorized, monkeypatch):
    _, _, found = factorized
    calls = []
    monkeypatch.setattr("pimper_torch.records.patches.not_unit", lambda *_: calls.append(1) or "")
    for _ in range(2):
        found.check("test")
    assert len(calls) == len(found.buckets)
    others = [one.replace(normals_patch=one.normals_patch.clone()) for one in found.buckets]
    found.replace(buckets=tuple(others)).check("test")
    assert len(calls) == 2 * len(found.buckets)


def test_a_plain_torch_module_may_replace_a_stage():
    class Plain(nn.Module):
        def forward(self, surface):
            return surface.mesh

    scene, coarse = small_scene(num_views=5, width=48)
    chain = chain_on(scene, coarse)
    chain.extract = Plain()
    *_, last = chain.steps(scene)
    assert len(chain.extract(last.surface).faces) == len(last.surface.faces)


def test_patches_are_counted_indexed_and_iterated(factorized):
    _, seen, found = factorized
    patches = found.patches
    assert len(found) == len(patches) == len(patches.coarse.mesh.faces)
    one = found[7]
    assert len(one) == 1
    assert one.patches.buckets[0].facet.tolist() == [7]
    place = next(i for i, b in enumerate(patches.buckets) if (b.facet == 7).any())
    row = patches.buckets[place].facet.tolist().index(7)
    assert torch.equal(one.buckets[0].albedo[0], found.buckets[place].albedo[row])
    assert torch.equal(seen[7].buckets[0].valid[0], seen.buckets[place].valid[row])
    assert [int(each.patches.buckets[0].facet) for each in found] == list(range(len(found)))
    with pytest.raises(IndexError, match="facet 99 has no patch"):
        found[99]


def test_a_number_per_patch_is_drawn_in_a_view(factorized, tmp_path):
    scene, seen, found = factorized
    statuses = pt.by_facet(found, "status")
    for templates, bucket in zip(found.patches.buckets, found.buckets, strict=True):
        assert torch.equal(statuses[templates.facet], bucket.status.float())
    residuals = pt.by_facet(found, "convergence.residual")
    coarse = found.patches.coarse
    pt.plot_in_view(coarse, scene.cameras, 0, residuals, "residual").savefig(tmp_path / "a.png")
    assert (tmp_path / "a.png").stat().st_size > 3000
    for record in (found.patches, seen, found):
        pt.plot_patch(record[3]).savefig(tmp_path / "b.png")
    assert [axes.get_title() for axes in pt.plot_patch(found[3]).axes][:2] == ["albedo", "normals"]
    with pytest.raises(pt.InputError, match="one value per patch"):
        pt.by_facet(found, "albedo")
    with pytest.raises(pt.InputError, match="needed: one for each of"):
        pt.plot_in_view(coarse, scene.cameras, 0, residuals[1:])
    with pytest.raises(pt.InputError, match="needed: one, such as"):
        pt.plot_patch(found)


def test_residuals_and_the_light_of_a_sample_are_drawn(factorized):
    _, seen, found = factorized
    views, own = seen[3].buckets[0], found[3].buckets[0]
    counted = (views.valid[0] & own.observed[0]).sum(dim=0)
    row, column = divmod(int(counted.argmax()), counted.shape[1])
    figure = pt.plot_patch(found[3], seen[3], (row, column))
    panels = {axes.get_title(): axes for axes in figure.axes}
    assert "residual" in panels
    observed, predicted = panels[f"sample {row}, {column}"].lines
    shown = views.valid[0, :, row, column].nonzero()[:, 0]
    assert observed.get_xdata().tolist() == shown.tolist()
    torch.testing.assert_close(
        torch.from_numpy(observed.get_ydata()), views.gray[0, shown, row, column]
    )
    light, normal = own.lights_patch[0, shown], own.normals_patch[0, row, column]
    shading = light[:, 0] + light[:, 1:] @ normal
    torch.testing.assert_close(
        torch.from_numpy(predicted.get_ydata()), own.albedo[0, row, column].mean() * shading
    )
    assert pt.plot_patch(found[3], seen[3]).axes[-1].get_title() != "residual"
    with pytest.raises(pt.InputError, match="photometry of one patch, and views of the same"):
        pt.plot_patch(found[3], seen[4])
    with pytest.raises(pt.InputError, match="is not valid in any view"):
        pt.plot_patch(found[3], seen[3], (0, 0))
    bucket = seen[3].buckets[0]
    unseen = seen[3].replace(buckets=[bucket.replace(valid=torch.zeros_like(bucket.valid))])
    titles = [axes.get_title() for axes in pt.plot_patch(found[3], unseen).axes]
    assert {"residual", "no valid sample"} <= set(titles)
