"""Ground truth of photographs."""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.records import Cameras, Mesh, Record, Views


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Truth(Record):
    """Ground truth of an object; ``None`` where unknown.

    Maps hold what the ray through each pixel's centre meets first, one a view.

    Attributes:
        mesh: Surface of the object alone, as scanned or as rendered.
        surroundings: What else stands in the scene, such as the table.
        points_world: Scanned points, where no surface was made of them.
        depth: Along the camera's z; infinite where the ray meets nothing, or unknown.
        normals_world: Unit, outward; zero where the ray meets nothing.
        albedo: Linear; zero where the ray meets nothing.
        foreground: True on the object, false on its table and the background.
        lit: True where the point light reaches the surface.
        highlight: True where a highlight adds noticeably to the matte part.
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
    """Photographs of a data set with all that came along.

    Views of one index in ``position`` were taken by the same camera from the same position;
    views of one index in ``light`` under the same light.

    Attributes:
        views: The photographs, linear radiance. Names are unique.
        cameras: That took them, world frame and unit of the data set; ``None`` if unknown.
    """

    views: Views
    cameras: Cameras | None
    truth: Truth
    position: Int[Tensor, " view"]
    light: Int[Tensor, " view"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class DtuProtocol(Record):
    """Where a scan of the DTU 2014 set is evaluated, in the data set's frame and millimetres.

    Attributes:
        obs_mask: True in voxels that the structured light scanner could see. The centre of
            voxel ``(i, j, k)`` is ``bounding_box[0] + resolution * (i, j, k)``.
        bounding_box: Lower corner, upper corner.
        resolution: Distance of neighbouring voxels.
        plane: Of the table; points with ``plane . (x, y, z, 1) > 0`` stand on it.
    """

    obs_mask: Bool[Tensor, "x y z"]
    bounding_box: Float[Tensor, "2 3"]
    resolution: float
    plane: Float[Tensor, " 4"]
