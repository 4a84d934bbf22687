"""Whether photographs show what their cameras see.

Square patches around points, which face a view, are compared with those of neighbouring views.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import grid_sample, normalize

from pimper_torch.geometry.pixels import grid_from_pixels, pixel_centers
from pimper_torch.geometry.projection import project
from pimper_torch.records import SparseScene
from pimper_torch.records.shapes import Scalars

# Points per pair of views, pixels of a patch's side and between them, neighbours of a view, and the
# widest angle between their axes in degrees: choices.
_POINTS, _SIDE, _STEP, _NEIGHBOURS, _WIDEST = 300, 9, 2.0, 8, 50.0
_FEWEST = 30  # points for a median
# Least correlation of the median view, and those of a view relative to it: docs/decisions.md,
# "Photographs of something else".
_ALIKE, _RELATIVE = 0.4, (0.4, 0.65)


def of_something_else(scene: SparseScene) -> dict[int, str]:
    """Return the views whose photographs do not show what their cameras see, and why so."""
    alike = correlations(scene)
    typical = alike.nanmedian(dim=0).values
    unlike = (alike < typical * typical.new_tensor(_RELATIVE)).all(dim=1) & (typical[0] >= _ALIKE)
    return {
        view: "its photograph does not show what its camera sees: at points, it correlates with "
        f"its neighbours by {alike[view, 0]:.2f}, the median view by {typical[0]:.2f}"
        for view in unlike.nonzero()[:, 0].tolist()
    }


@torch.no_grad()
def correlations(scene: SparseScene) -> Float[Tensor, "view 2"]:
    """Return how well views correlate with the most similar of their neighbours.

    Returns:
        Median, and 0.8 quantile, of the correlation of patches around points that the neighbour
        observes, which a view may not see; NaN if there are hardly any.
    """
    axes = scene.cameras.cam_from_world[:, 2, :3]
    angles = torch.rad2deg((axes @ axes.mT).clamp(-1, 1).acos()).fill_diagonal_(torch.inf)
    observed, best = scene.observed.mT, axes.new_full((len(axes), 2), torch.nan)
    for view, angle in enumerate(angles):
        near = angle.argsort()[:_NEIGHBOURS]
        found = [
            _correlation(scene, view, int(other), observed[other])
            for other in near[angle[near] < _WIDEST].tolist()
        ]
        valid = [x.quantile(x.new_tensor([0.5, 0.8])) for x in found if len(x) >= _FEWEST]
        if valid:
            best[view] = torch.stack(valid).amax(dim=0)
    return best


def _correlation(scene: SparseScene, view: int, other: int, observed: Tensor) -> Scalars:
    """Return the correlation of patches of two views around points that the other observes."""
    cameras, size = scene.cameras, scene.views.sizes_px[view]
    pose, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
    points = scene.points_world[observed]
    pixels, depth = project(points, pose, intrinsics)
    inside = ((pixels > 0) & (pixels < size)).all(dim=-1) & (depth > 0)
    points, depth = points[inside], depth[inside]
    step = -(-len(points) // _POINTS) or 1
    points, depth = points[::step], depth[::step]
    offsets = _STEP * (pixel_centers(_SIDE, _SIDE, like=points).reshape(-1, 2) - _SIDE / 2)
    scale = (depth / intrinsics[0, 0])[:, None, None]
    patches = points[:, None] + scale * (offsets @ pose[:2, :3])
    samples = []
    for index in (view, other):
        pixels, _ = project(patches, cameras.cam_from_world[index], cameras.intrinsics[index])
        width, height = scene.views.sizes_px[index].tolist()
        image = scene.views.images[index][None, :, :height, :width]
        grid = grid_from_pixels(pixels, width, height)[None].to(image)
        values = grid_sample(image, grid, align_corners=False)[0].mean(dim=0)
        samples.append(normalize(values - values.mean(dim=-1, keepdim=True), dim=-1))
    return (samples[0] * samples[1]).sum(dim=-1).nan_to_num()
