"""A rendered scene and the truth about it."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.records import Cameras, Mesh, Record, Views


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class RenderedScene(Record):
    """Photographs that no camera took, and everything they were computed from.

    Per-view maps hold what the ray through each pixel's centre meets first.

    Attributes:
        lights_world: First-order light ``l`` at the object: radiance is
            albedo * l . (1, n). Exact for closed-form scenes; for ray-traced ones the
            light at the target, without fall-off, shadows and highlights.
        depth: Along the camera's z; infinite where the ray meets nothing.
        normals_world: Unit, outward; zero where the ray meets nothing.
        albedo: Linear; zero where the ray meets nothing.
        foreground: True on the object, false on the table and the background.
        lit: True where the point light reaches the surface.
        highlight: True where a highlight adds noticeably to the matte part.
        mesh: What was ray traced; ``None`` for closed forms.
    """

    views: Views
    cameras: Cameras
    lights_world: Float[Tensor, "view 4"]
    depth: Float[Tensor, "view height width"]
    normals_world: Float[Tensor, "view height width 3"]
    albedo: Float[Tensor, "view height width channel"]
    foreground: Bool[Tensor, "view height width"]
    lit: Bool[Tensor, "view height width"]
    highlight: Bool[Tensor, "view height width"]
    mesh: Mesh | None = None
