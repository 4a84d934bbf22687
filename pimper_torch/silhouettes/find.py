"""Which pixels of every view show the object."""

import warnings
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate

from pimper_torch.config import require
from pimper_torch.errors import InputError, PimperWarning
from pimper_torch.parallel import side_by_side
from pimper_torch.records import Silhouettes, SparseScene, Views
from pimper_torch.silhouettes.agreement import Agreement, agreement_of, repaired
from pimper_torch.silhouettes.cloud import pixels_seen, split_cloud
from pimper_torch.silhouettes.cuts import Cues, Cuts, cut_in_iterations
from pimper_torch.silhouettes.opencv import signed_distance
from pimper_torch.silhouettes.parallax import plane_agreement
from pimper_torch.silhouettes.pictures import working_pictures
from pimper_torch.silhouettes.supporting_plane import fixation, supporting_plane, well_tracked
from pimper_torch.stage import Stage

_BOX = 0.75  # half its side, of the cameras' distance: photographs of 70 degrees
# Probabilities where a view's cut and the hull contradict each other by more than two pixels.
_UNSURE_INSIDE, _UNSURE_OUTSIDE = 0.6, 0.3
_SOFT = 0.5  # working pixels: the width of a border
_USED = 0.25  # probability above which a pixel is used as the object's


@dataclass(frozen=True, slots=True, kw_only=True)
class SilhouetteConfig:
    """Settings of :class:`FindSilhouettes`.

    Attributes:
        object: Find silhouettes and fall back to everything (``auto``), take the masks that come
            with the photographs (``masks``), or take all that the photographs show for the object
            (``everything``), as for walls, height fields and scenes. Masks that are given are
            believed by ``auto``, too.
        region: Box that the object is inside: smallest x, y, z, then largest, scene units; none
            unless given.
        size_px: Longer side of the pictures that are cut.
    """

    object: Literal["auto", "masks", "everything"] = "auto"
    region: tuple[float, ...] = ()
    size_px: int = 640

    def __post_init__(self) -> None:
        require(self.size_px >= 64, "size_px", self.size_px, "64 or more")
        low, high = self.region[:3], self.region[3:]
        fits = len(self.region) in (0, 6) and all(a < b for a, b in zip(low, high, strict=True))
        require(fits, "region", self.region, "nothing, or smallest x, y, z, then largest")


@dataclass(frozen=True, slots=True, kw_only=True)
class SilhouetteDetails:
    """What of :class:`FindSilhouettes` is the same for all photographs.

    Chosen on the four rendered scenes and the skull (``benchmarks/silhouettes.py``).

    Attributes:
        iterations: Of cutting and voting after the first cut.
        num_voxels: Of the visual hull.
        disagreeing: Fraction of the views that may see a voxel of the hull outside.
        plane_tolerance: Distance up to which a point lies on the supporting plane, as a fraction of
            the cameras' distance.
        min_on_plane: Fraction of the points that lie on it.
        max_below_plane: Fraction of the points that may lie below it.
        min_covered: Fraction of a view's silhouette that the hull's projection must cover, or the
            view is not reliable.
        min_overlap: Intersection over union of silhouettes and projections, in the median, below
            which silhouettes are not reliable.
        seed: Of the plane's trials.
    """

    iterations: int = 2
    num_voxels: int = 500_000
    disagreeing: float = 0.05
    plane_tolerance: float = 0.004
    min_on_plane: float = 0.08
    max_below_plane: float = 0.05
    min_covered: float = 0.9
    min_overlap: float = 0.8
    seed: int = 0


class FindSilhouettes(Stage):
    """Find the object's silhouette in every view; a constant to autograd."""

    def __init__(
        self, config: SilhouetteConfig | None = None, details: SilhouetteDetails | None = None
    ) -> None:
        super().__init__()
        self.config = config or SilhouetteConfig()
        self.details = details or SilhouetteDetails()

    @torch.no_grad()
    def forward(self, scene: SparseScene) -> Silhouettes:
        """Find silhouettes, or take the masks for them.

        Args:
            scene: Photographs, cameras and cloud.

        Returns:
            Everything where that is asked for, and, with a
            :class:`~pimper_torch.errors.PimperWarning` that says why, where silhouettes cannot be
            reliable.

        Raises:
            InputError: Masks are asked for, and none are given.
        """
        config, masks = self.config, scene.views.masks
        everything = Silhouettes.everything(scene.views)
        if config.object == "everything":
            return everything
        if masks is not None:
            reliable = torch.ones(len(masks), dtype=torch.bool, device=masks.device)
            return Silhouettes(inside=masks.float(), reliable=reliable, source="masks")
        if config.object == "masks":
            raise InputError(
                "`silhouettes.object` is masks, but the photographs come without any. Give a "
                "folder of masks, or let silhouettes be found: `silhouettes.object` auto."
            )
        cuts = self._cuts(scene)
        if cuts is None:
            _warn("the views' silhouettes have nothing in common")
            return everything
        doubt = self._doubt(agreement_of(cuts))
        if doubt:
            _warn(doubt)
            return everything
        cuts = repaired(cuts)
        found = _at_full_size(cuts, scene.views)
        reliable = agreement_of(cuts).reliable(self.details.min_covered).to(found.device)
        return Silhouettes(inside=found, reliable=reliable, source="found")

    def _cuts(self, scene: SparseScene) -> Cuts | None:
        config, details = self.config, self.details
        scene = scene.to("cpu", torch.float32)
        pictures = working_pictures(scene.views, scene.cameras, config.size_px)
        cameras, points = pictures.cameras, scene.points_world
        focus = fixation(cameras)
        tolerance = details.plane_tolerance * float(focus.distance)
        plane = supporting_plane(
            points[well_tracked(scene)],
            cameras,
            tolerance=tolerance,
            min_on=details.min_on_plane,
            max_below=details.max_below_plane,
            generator=torch.Generator().manual_seed(details.seed),
        )
        region = (
            torch.tensor(config.region, dtype=torch.float32).reshape(2, 3)
            if config.region
            else None
        )
        cloud = split_cloud(scene, focus, plane, tolerance, region)
        half = _BOX * focus.distance
        centre = focus.fixation_world
        agreement = None if plane is None else plane_agreement(pictures, plane, focus)
        cues = Cues(
            pictures=pictures,
            object_px=tuple(pixels_seen(scene, cameras, cloud.on_object)),
            background_px=tuple(pixels_seen(scene, cameras, cloud.background)),
            plane=plane,
            agreement=agreement,
            fixation=focus,
            box_world=torch.stack([centre - half, centre + half]) if region is None else region,
        )
        if plane is None and not cues.has_points:
            return None
        return cut_in_iterations(
            cues,
            iterations=details.iterations,
            disagreeing=details.disagreeing,
            num_voxels=details.num_voxels,
        )

    def _doubt(self, agreement: Agreement) -> str:
        """Say why silhouettes are unreliable, or nothing."""
        reliable = agreement.reliable(self.details.min_covered)
        overlap = float(agreement.overlap.median())
        if overlap < self.details.min_overlap:
            return (
                f"silhouettes overlap with the hull of all views by {overlap:.0%} in the median; "
                f"needed: {self.details.min_overlap:.0%}"
            )
        if int(reliable.sum()) < max(3, len(reliable) / 2):
            return (
                f"only {int(reliable.sum())} of {len(reliable)} silhouettes agree with the others"
            )
        return ""


def masked(scene: SparseScene, silhouettes: Silhouettes) -> SparseScene:
    """Give the scene with silhouettes that were found for masks, a little wider where unsure.

    Args:
        scene: With photographs.
        silhouettes: Masks that a person gave stay as they are, whether or not they are the object.
    """
    if silhouettes.source != "found":
        return scene
    return scene.replace(views=scene.views.replace(masks=silhouettes.inside > _USED))


def _warn(why: str) -> None:
    warnings.warn(
        f"Everything that the photographs show is taken for the object: {why}. Give masks, or a "
        "box round the object (`silhouettes.region`); `silhouettes.object` everything says that "
        "this is meant.",
        PimperWarning,
        stacklevel=3,
    )


def _at_full_size(cuts: Cuts, views: Views) -> Float[Tensor, "view height width"]:
    """Turn cuts into probabilities at the photographs' size; 0 in the padding."""
    height, width = views.images.shape[-2:]
    device = views.images.device

    def enlarged(view: int) -> Float[Tensor, "height width"]:
        cut, margin = cuts.masks[view], cuts.margins_px[view]
        layers = torch.stack([signed_distance(cut), margin.clamp(-100, 100)])
        border, hull = interpolate(
            layers[None], (height, width), mode="bilinear", align_corners=False
        )[0]
        inside = torch.sigmoid(border / _SOFT)
        inside = torch.where((border > 2) & (hull < -2), _UNSURE_INSIDE, inside)
        return torch.where((border < -2) & (hull > 2), _UNSURE_OUTSIDE, inside)

    found = torch.empty(len(cuts.masks), height, width, device=device)
    for view, inside in enumerate(side_by_side(enlarged, range(len(cuts.masks)), tracked=False)):
        found[view] = inside.to(device)
    return found * views.inside
