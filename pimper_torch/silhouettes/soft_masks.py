"""Soft masks from elsewhere, as those of a segmenter, and as much of them as the views confirm.

A segmenter errs by the picture: it takes a shadow or another thing along, or finds another thing
altogether. What it takes along in one photograph the hull of the others leaves out; photographs in
which it misses what most of the others have in common are doubted.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt, label
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from pimper_torch.geometry.projection import rays_through
from pimper_torch.records import Cameras, Record, SilhouettePrior, Views
from pimper_torch.silhouettes.hull import Hull
from pimper_torch.silhouettes.working_size import WorkingPictures

FEW = 3  # soft masks: fewer have no majority
_SAYS_NOTHING = 0.1  # about one half: maps are resampled on their way here
_SURE = 1e-3  # probabilities nearer to 0 or 1 than this count no more: 8 bits hold no finer ones


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class SoftMasks(Record):
    """Silhouettes that priors state, at the working size.

    Attributes:
        inside: Probability of the object; one half where nothing is said.
        seeds_px: Pixels of the object in each view, from maps that say nothing else.
    """

    inside: Float[Tensor, "view height width"]
    given: Bool[Tensor, " view"]
    seeds_px: tuple[Float[Tensor, "_ 2"], ...]

    @property
    def points(self) -> bool:
        """Whether anything is pointed at."""
        return any(len(pixels) for pixels in self.seeds_px)

    @property
    def masks(self) -> Bool[Tensor, "view height width"]:
        """True where a pixel more likely shows the object than not."""
        return self.inside > 0.5


def soft_masks_of(views: Views, pictures: WorkingPictures) -> SoftMasks | None:
    """Merge the silhouettes that views carry as priors; ``None`` without any.

    Log odds of several maps of one view add up. A map that nowhere says that the object is not
    there points at it, as clicks do.
    """
    odds, seeds = torch.zeros_like(pictures.grey), torch.zeros_like(pictures.grey, dtype=torch.bool)
    given = torch.zeros(len(odds), dtype=torch.bool)
    priors = [prior for prior in views.priors if isinstance(prior, SilhouettePrior)]
    for prior in priors:
        for name, size, full in zip(prior.names, prior.sizes_px, prior.inside, strict=True):
            if name not in views.names:
                continue
            view = views.names.index(name)
            inside = full[: size[1], : size[0]].detach().float().cpu()
            wide, high = pictures.cameras.sizes_px[view].tolist()
            small = interpolate(
                inside[None, None],
                (high, wide),
                mode="bilinear",
                align_corners=False,
                antialias=True,
            )
            if float(inside.min()) > 0.5 - _SAYS_NOTHING:
                seeds[view, :high, :wide] |= small[0, 0] > 0.5 + _SAYS_NOTHING
            else:
                odds[view, :high, :wide] += torch.logit(small[0, 0].clamp(_SURE, 1 - _SURE))
                given[view] = True
    if not priors:
        return None
    centres = tuple(one.nonzero().flip(1).float() + 0.5 for one in seeds)
    return SoftMasks(inside=torch.sigmoid(odds), given=given, seeds_px=centres)


def pointed_at(hull: Hull, cameras: Cameras, seeds_px: Sequence[Float[Tensor, "_ 2"]]) -> Hull:
    """Keep the components of a hull that rays through seeds meet first.

    Returns:
        The hull itself where none are met.
    """
    labels = torch.from_numpy(label(hull.occupied.numpy())[0])
    met: set[int] = set()
    for view, pixels in enumerate(seeds_px):
        if len(pixels):
            pose, eye = cameras.cam_from_world[view], cameras.centers_world[view]
            rays = normalize(rays_through(pixels, pose, cameras.intrinsics[view]), dim=1)
            far = (hull.corners_world - eye).norm(dim=1).sum()
            along = torch.arange(0, float(far), float(hull.spacing) / 2)
            places = (eye + along[:, None] * rays[:, None] - hull.origin_world) / hull.spacing
            index = places.round().long()
            last = torch.tensor(labels.shape) - 1
            inside = ((index >= 0) & (index <= last)).all(dim=-1)
            x, y, z = torch.minimum(index.clamp_min(0), last).unbind(dim=-1)
            found = labels[x, y, z] * inside
            first = found.gather(1, (found > 0).int().argmax(dim=1, keepdim=True))
            met |= set(first.flatten().tolist()) - {0}
    if not met:
        return hull
    kept = torch.isin(labels, torch.tensor(sorted(met)))
    away = torch.from_numpy(distance_transform_edt(~kept.numpy())).to(hull.distance)
    outside = torch.minimum(hull.distance, (1 - away) * hull.spacing)
    return hull.replace(distance=torch.where(kept, hull.distance, outside))
