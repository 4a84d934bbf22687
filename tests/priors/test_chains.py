import pytest
import torch
from torch import nn
from torch.testing import assert_close

import pimper_torch as pt
from pimper_torch.runtime.errors import PimperWarning


class Caught(Exception):  # noqa: N818 - not an error: it ends the chain early
    """Carries the arguments of a stage."""


class Catching(nn.Module):
    """A stage that ends the chain."""

    def forward(self, scene, *_):
        raise Caught(scene)


@pytest.mark.parametrize("chain", ["default", "paper"])
def test_chains_pass_on_undistorted_normals_in_opencv_axes(chain, rendered):
    """DSINE's normals of distorted photographs; later stages get resolved conventions."""
    scene = rendered.scene
    fx, fy, cx, cy = scene.lenses[0].params
    lens = scene.lenses[0].replace(model="OPENCV", params=(fx, fy, cx, cy, 0.05, 0, 0, 0))
    normals = pt.NormalPrior(
        names=scene.views.names,
        sizes_px=scene.views.sizes_px,
        normals=-rendered.camera,
        variance=torch.where(rendered.camera.norm(dim=-1) > 0.5, 0.1, torch.inf),
        axes=None,
    )
    given = scene.replace(
        lenses=(lens,) * 12, views=scene.views.replace(priors=(normals,), masks=None)
    )
    stages = {"silhouettes": pt.Given(rendered.silhouettes)}
    stages["coarse_surface" if chain == "default" else "triangulate"] = Catching()
    config = pt.load_config(chain).__class__()
    made = (pt.CoarseToFine if chain == "default" else pt.Published)(config, **stages)
    with pytest.warns(PimperWarning, match="in axes of DSINE"), pytest.raises(Caught) as caught:
        made(given)
    (found,) = caught.value.args[0].views.priors
    assert (found.axes, found.frame, found.undistorted) == ("opencv", "camera", True)
    # Undistortion keeps the centre of a photograph and moves its border.
    assert_close(found.normals[:, 60, 80], rendered.camera[:, 60, 80], rtol=0, atol=0.02)
    known = found.variance[:, 10].isfinite()
    assert (found.normals - rendered.camera)[:, 10][known].norm(dim=-1).mean() > 0.005
