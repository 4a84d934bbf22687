"""Ground truth of photographs."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records import Cameras, Mesh, Record, Views


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Truth(Record):
    """Ground truth of an object; ``None`` where unknown.

    Maps have one entry per view, for the first intersection of the ray through each pixel's centre.

    Attributes:
        mesh: Surface of the object alone, scanned or rendered.
        surroundings: Other surfaces of the scene, such as the table.
        points_world: Scanned points, if they have no surface.
        depth: Along the camera's z; infinite off all surfaces, or unknown.
        normals_world: Unit, outward; zero off all surfaces.
        albedo: Linear; zero off all surfaces.
        foreground: True on the object, false on its table and the background.
        lit: True where the point light illuminates the surface.
        highlight: True where a highlight adds noticeably to the diffuse reflection.
        lights_world: First-order light ``l`` at the object, radiance = albedo * l . (1, n),
            up to one scale for all views.
    """

    mesh: Mesh | None = None
    surroundings: Mesh | None = None
    points_world: Float[Tensor, "point 3"] | None = None
    depth: Float[Tensor, "view height width"] | None = None
    normals_world: Float[Tensor, "view height width 3"] | None = None
    albedo: Float[Tensor, "view height width channel"] | None = None
    foreground: Bool[Tensor, "view height width"] | None = None
    lit: Bool[Tensor, "view height width"] | None = None
    highlight: Bool[Tensor, "view height width"] | None = None
    lights_world: Float[Tensor, "view 4"] | None = None


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Capture(Record):
    """Photographs of a data set with cameras and ground truth.

    Views of one index in ``position`` were taken by the same camera from the same position;
    views of one index in ``light`` under the same light.

    Attributes:
        views: The photographs, linear radiance. Names are unique.
        cameras: Their cameras, world frame and unit of the data set; ``None`` if unknown.
    """

    views: Views
    cameras: Cameras | None
    truth: Truth
    position: Int[Tensor, " view"]
    light: Int[Tensor, " view"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DtuProtocol(Record):
    """Evaluated region of a scan of the DTU 2014 set, in the data set's frame and millimetres.

    Attributes:
        obs_mask: True in voxels visible to the structured light scanner. The centre of
            voxel ``(i, j, k)`` is ``bounding_box[0] + resolution * (i, j, k)``.
        bounding_box: Lower corner, upper corner.
        resolution: Distance of neighbouring voxels.
        plane: Of the table; points with ``plane . (x, y, z, 1) > 0`` are above it.
    """

    obs_mask: Bool[Tensor, "x y z"]
    bounding_box: Float[Tensor, "2 3"]
    resolution: float
    plane: Float[Tensor, " 4"]
