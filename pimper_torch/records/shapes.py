"""Aliases of the most frequent tensor types in signatures: dtype and named axes.

An axis name has the same length in all arguments of a call, whether in an alias or written out.
"""

from jaxtyping import Bool, Float, Int
from torch import Tensor

Vertices = Float[Tensor, "vertex 3"]
Faces = Int[Tensor, "face 3"]
Points = Float[Tensor, "point 3"]
Pixels = Float[Tensor, "point 2"]
PointMask = Bool[Tensor, " point"]
PerVertex = Float[Tensor, " vertex"]
VertexMask = Bool[Tensor, " vertex"]
VertexValues = Float[Tensor, "vertex channel"]
Edges = Int[Tensor, "edge 2"]
FaceMask = Bool[Tensor, " face"]
Map = Float[Tensor, "height width"]
Mask = Bool[Tensor, "height width"]
Maps = Float[Tensor, "view height width"]
Masks = Bool[Tensor, "view height width"]
ViewMask = Bool[Tensor, " view"]
PerView = Float[Tensor, " view"]
ViewVectors = Float[Tensor, "view 3"]
Images = Float[Tensor, "view channel height width"]
VectorMap = Float[Tensor, "height width 3"]
Poses = Float[Tensor, "view 4 4"]
Facets = Int[Tensor, "facet 3"]
PerFacet = Float[Tensor, " facet"]
PatchRaster = Float[Tensor, "patch height width"]
PatchMask = Bool[Tensor, "patch height width"]
PatchMasks = Bool[Tensor, "patch view height width"]
PatchVectors = Float[Tensor, "patch height width 3"]
Vectors = Float[Tensor, "*batch 3"]
Scalars = Float[Tensor, "*batch"]
Scalar = Float[Tensor, ""]
Matrix3 = Float[Tensor, "3 3"]
Vector = Float[Tensor, "3"]
Pose = Float[Tensor, "4 4"]
PerEntry = Float[Tensor, " entry"]
Unknowns = Float[Tensor, "unknown ..."]
Sides = Float[Tensor, "unknown side"]
