"""Types of tensors that signatures name most often: dtype and axes, which are bound as written.

An axis of one name has one length in all arguments of a call, whether an alias or its long form
names it.
"""

from jaxtyping import Bool, Float, Int
from torch import Tensor

Vertices = Float[Tensor, "vertex 3"]
Faces = Int[Tensor, "face 3"]
Points = Float[Tensor, "point 3"]
Pixels = Float[Tensor, "point 2"]
PerVertex = Float[Tensor, " vertex"]
VertexMask = Bool[Tensor, " vertex"]
FaceMask = Bool[Tensor, " face"]
Map = Float[Tensor, "height width"]
Mask = Bool[Tensor, "height width"]
Maps = Float[Tensor, "view height width"]
Masks = Bool[Tensor, "view height width"]
ViewMask = Bool[Tensor, " view"]
Vectors = Float[Tensor, "*batch 3"]
Scalars = Float[Tensor, "*batch"]
Scalar = Float[Tensor, ""]
Matrix3 = Float[Tensor, "3 3"]
