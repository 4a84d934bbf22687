"""Values of images at vertices."""

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import grid_sample

from pimper_torch.geometry.pixels import grid_from_pixels
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.visibility import visible_vertices
from pimper_torch.records import Cameras, Surface
from pimper_torch.records.shapes import Points
from pimper_torch.runtime.torch_settings import isolated

Visible = Bool[Tensor, "view vertex"]

_MIN_COSINE = 0.4  # vertices at more than 66 degrees are foreshortened: a choice


@isolated
def well_visible(surface: Surface, cameras: Cameras) -> Visible:
    """Return the vertices that the photographs determine, and each camera sees not too obliquely.

    Pass those of a first step to the losses of all steps, as they are a discrete choice.
    """
    return visible_vertices(surface.mesh, cameras, _MIN_COSINE) & surface.supported


@isolated
def in_view(
    points_world: Points, cameras: Cameras, view: int
) -> tuple[Float[Tensor, "point 2"], Float[Tensor, " point"]]:
    """Project points into one view; see :func:`~pimper_torch.geometry.projection.project`."""
    camera = cameras.cam_from_world[view], cameras.intrinsics[view]
    return project(points_world, *(matrix.to(points_world) for matrix in camera))


def interpolated_at(
    image: Float[Tensor, "channel height width"], pixels: Float[Tensor, "point 2"]
) -> Float[Tensor, "point channel"]:
    """Interpolate an image bilinearly at pixels; differentiable in both."""
    grid = grid_from_pixels(pixels.to(image), image.shape[-1], image.shape[-2])
    values = grid_sample(image[None], grid[None, None], padding_mode="border", align_corners=False)
    return values[0, :, 0].mT
