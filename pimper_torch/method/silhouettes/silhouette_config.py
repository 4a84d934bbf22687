"""Settings of finding and correcting silhouettes."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pimper_torch.ground.geometry.supporting_plane import PlaneSearch
from pimper_torch.runtime.config import Range, require, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class SilhouetteConfig:
    """Settings of :class:`~pimper_torch.method.silhouettes.find.FindSilhouettes`.

    Attributes:
        object: Find silhouettes and fall back to everything (``auto``), take the masks that come
            with the photographs (``masks``), or take all that the photographs show for the object
            (``everything``), as for walls, height fields and scenes. Masks that are given are
            taken by ``auto``, too.
        region: Box that the object is inside: smallest x, y, z, then largest, in the cameras'
            frame; none unless given.
        size_px: Longer side of the pictures that are cut.
    """

    object: Literal["auto", "masks", "everything"] = "auto"
    region: tuple[float, ...] = ()
    size_px: Annotated[int, Range(least=64, most=65_535)] = 640

    def __post_init__(self) -> None:
        require_ranges(self)
        low, high = self.region[:3], self.region[3:]
        fits = len(self.region) in (0, 6) and all(a < b for a, b in zip(low, high, strict=True))
        require(fits, "region", self.region, "nothing, or smallest x, y, z, then largest")


@dataclass(frozen=True, slots=True, kw_only=True)
class SilhouetteDetails:
    """Settings of the search for silhouettes that all photographs share.

    See :class:`~pimper_torch.method.silhouettes.find.FindSilhouettes`. Chosen on the four rendered
    scenes and the skull (``benchmarks/silhouettes.py``).

    Attributes:
        iterations: Of cutting and voting after the first cut.
        disagreeing: Fraction of the views that may see a voxel of the hull outside.
        min_covered: Fraction of a view's silhouette that the hull's projection must cover, or the
            view is not reliable.
        max_exposed: Fraction of a view's silhouette that may show a background for certain: the
            supporting plane, or a room at rest. True masks show up to 0.001, masks 20 px of 640 too
            wide 0.007 to 0.19 (mug, potatoes and scorpion, two of them on turntables).
        min_held: Fraction of the object's points that a view's silhouette must hold. True masks
            hold 0.948 and more, masks 20 px too narrow 0.50 to 0.80 (mug, potatoes).
        min_overlap: Intersection over union of silhouettes and projections, in the median, below
            which silhouettes are not reliable.
    """

    iterations: int = 2
    num_voxels: int = 500_000
    disagreeing: float = 0.05
    plane: PlaneSearch = field(default_factory=PlaneSearch)
    min_covered: float = 0.9
    max_exposed: float = 0.01
    min_held: float = 0.9
    min_overlap: float = 0.8
