"""The stage that finds the object's silhouette in every view."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from scipy.ndimage import label
from torch import Tensor, nn

from pimper_torch.geometry.supporting_plane import PLANE_TOLERANCE
from pimper_torch.geometry.visual_hull import bounding_cube, margins, visual_hull
from pimper_torch.kernels.compile import COARSE
from pimper_torch.records import Failure, Silhouettes, SparseScene
from pimper_torch.records.scene import ViewPerPose, with_views
from pimper_torch.records.shapes import ViewMask
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.runtime.failures import skipped
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import by_view
from pimper_torch.stages.silhouettes.cues import Cues, cues_of
from pimper_torch.stages.silhouettes.cuts import NUM_VOXELS, Cuts, cut_in_iterations
from pimper_torch.stages.silhouettes.given import contradictory
from pimper_torch.stages.silhouettes.network import own_network
from pimper_torch.stages.silhouettes.read_again import read_again
from pimper_torch.stages.silhouettes.reliability import (
    MAX_EXPOSED,
    MIN_HELD,
    agreement_of,
    silhouettes_of,
)
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig
from pimper_torch.stages.stage import Stage

# Median intersection over union of silhouettes and hull projections, below which silhouettes are
# not reliable.
_MIN_OVERLAP = 0.8
_USED = 0.25  # probability above which a pixel belongs to the mask of the object
_UNLIKE = "its soft mask lacks most of the common hull of the others"
_BY_HULL = "The hull of the other masks replaces them, and they do not constrain the surface"


class FindSilhouettes(Stage):
    """Find the object's silhouette in every view. Not differentiable.

    Args:
        network: Reads the maps :data:`~pimper_torch.stages.silhouettes.evidence.MAPS` of one view,
            (1, map, height, width), and returns log odds of the object, (1, height, width). By
            default a network of the package, trained on rendered photographs.
    """

    kept_as = Silhouettes
    kernels = COARSE

    def __init__(
        self, config: SilhouetteConfig | None = None, network: nn.Module | None = None
    ) -> None:
        super().__init__()
        self.config = config or SilhouetteConfig()
        self.network = network

    @torch.no_grad()
    def forward(self, scene: SparseScene) -> Silhouettes:
        """Find silhouettes, or use the masks.

        Returns:
            Silhouettes of the full images if the configuration asks for it. A mask that clearly
            contradicts the others is replaced by their hull. If silhouettes are not reliable,
            everything above the supporting plane, or everything without a plane, with a
            :class:`~pimper_torch.runtime.errors.PimperWarning` that gives the reason. If the object
            was moved between capture sessions, silhouettes are found in each session separately.

        Raises:
            InputError: At most half of the masks agree, or a click is outside the common hull.
        """
        config, masks = self.config, scene.views.masks
        if config.object == "everything":
            return Silhouettes.everything(scene.views)
        if masks is not None:
            reliable = torch.ones(len(masks), dtype=torch.bool, device=masks.device)
            silhouettes = Silhouettes(
                inside=by_view(Tensor.float, masks), reliable=reliable, source="masks"
            ).to(masks.device)
            return self._replace_rejected(_without_empty(silhouettes, scene.views.names), scene)
        if config.object == "masks":
            raise InputError(
                "`silhouettes.object` is masks, but the photographs have no masks. Give a folder "
                "of masks, or set `silhouettes.object` to auto to find silhouettes."
            )
        return by_session(scene, self._find).to(scene.views.images.device)

    def _replace_rejected(self, silhouettes: Silhouettes, scene: SparseScene) -> Silhouettes:
        """Replace masks that clearly contradict the others by the hull of the others."""
        rejected = contradictory(scene).to(silhouettes.reliable.device)
        if not bool(rejected.any()):
            return silhouettes
        if torch.equal(rejected, silhouettes.reliable):
            raise InputError(
                "The masks contradict each other, and at most half of them agree. Check whether "
                "they show the same object in all photographs, and whether the cameras belong to "
                "these photographs; or omit the masks."
            )
        _warn(rejected, scene.views.names, "its mask contradicts those of the others", _BY_HULL)
        others = silhouettes.replace(reliable=silhouettes.reliable & ~rejected)
        cameras, box = scene.cameras.to(torch.float32), bounding_cube(others, scene.cameras)
        hull = None
        if box is not None:
            hull = visual_hull(others, cameras, box.float(), num_voxels=NUM_VOXELS)
        valid = scene.views.inside
        inside = by_view(Tensor.detach, silhouettes.inside)
        for view in rejected.nonzero()[:, 0].tolist():
            # Undistorted pixels from outside the photograph are black.
            inside[view] = valid[view] & (scene.views.images[view].detach().amax(dim=0) > 0)
            if hull is not None:
                width, height = (int(side) for side in scene.views.sizes_px[view])
                K, pose = cameras.intrinsics[view], cameras.cam_from_world[view]
                inside[view, :height, :width] *= margins(hull, K, pose, (width, height)) > 0
        return others.replace(inside=inside)

    def _find(self, scene: SparseScene) -> Silhouettes:
        """Find silhouettes in photographs between which the object did not move."""
        cues = cues_of(scene, self.config)
        cuts, reason = _cut(cues)
        if reason and cues.soft is not None and not cues.soft.points:
            # The component that the cameras look at is more likely than all of them.
            cuts, reason = _cut(cues.seed_at_fixation())
        unguided = cues.soft is None and not self.config.region
        if cuts is not None and cues.plane is not None and unguided:
            network = own_network() if self.network is None else self.network
            cuts = read_again(cues, cuts, network)
            reason = _unreliable_reason(cuts)
        leave_out("silhouettes.disagreement", bool(reason))
        if cuts is None or reason:
            region = "in the photographs" if cues.plane is None else "above the supporting plane"
            caution(
                f"Everything {region} is treated as the object: {reason}. Give masks, or a box "
                "around the object (`silhouettes.region`). If this is intended, set "
                "`silhouettes.object` to everything.",
                stacklevel=2,
            )
            return Silhouettes.everything(scene.views, _plane_top(cues))
        if views_missed := _views_missed(cues, cuts):
            names = some([scene.views.names[view] for view in views_missed])
            raise InputError(
                f"A click in {names} is outside the silhouettes and their hull; needed: a pixel of "
                "the object. Choose another one by `--object-at`, or give masks that contain it."
            )
        _warn(cuts.rejected, scene.views.names, _UNLIKE, "It is cut without the soft mask")
        return _without_empty(silhouettes_of(cuts, scene.views), scene.views.names)


def _cut(cues: Cues) -> tuple[Cuts | None, str]:
    """Cut all views; return the cuts, and why they are unreliable, or an empty string."""
    cuts = cut_in_iterations(cues)
    if cuts is None:
        return None, "the views' silhouettes have nothing in common"
    return cuts, _unreliable_reason(cuts)


def _views_missed(cues: Cues, cuts: Cuts) -> list[int]:
    """List the views with a click outside both the cut and the hull."""
    missed = []
    for view, seeds_px in enumerate(cues.soft.seeds_px if cues.soft else ()):
        column, row = seeds_px.long().unbind(dim=1)
        seeds = torch.zeros_like(cuts.masks[view])
        seeds[row, column] = True
        object_mask = cuts.masks[view] | (cuts.margins_px[view] > 0)
        clicks, count = label(seeds.numpy(), structure=[[1] * 3] * 3)
        if len(set(clicks[(seeds & object_mask).numpy()].tolist())) < count:
            missed.append(view)
    return missed


def _plane_top(cues: Cues) -> Float[Tensor, "plane 4"] | None:
    """Return the supporting plane's upper side, raised by the roughness of its points."""
    if cues.plane is None:
        return None
    thickness = PLANE_TOLERANCE * cues.fixation.distance
    height = cues.plane.offset + thickness
    return torch.cat([cues.plane.normal_world, -height.reshape(1)])[None]


def _unreliable_reason(cuts: Cuts) -> str:
    overlaps, reliable = agreement_of(cuts)
    overlap = float(overlaps.median())
    if overlap < _MIN_OVERLAP:
        return (
            f"silhouettes overlap with the hull of all views by {overlap:.0%} in the median; "
            f"needed: {_MIN_OVERLAP:.0%}"
        )
    exposed, held = float(cuts.exposed.median()), float(cuts.held.median())
    if exposed > MAX_EXPOSED:
        return (
            f"silhouettes show background on {exposed:.0%} of their pixels in the median; at most: "
            f"{MAX_EXPOSED:.0%}"
        )
    if held < MIN_HELD:
        return (
            f"silhouettes contain {held:.0%} of the object's points in the median; needed: "
            f"{MIN_HELD:.0%}"
        )
    if int(reliable.sum()) < max(3, len(reliable) / 2):
        return f"only {int(reliable.sum())} of {len(reliable)} silhouettes agree with the others"
    return ""


def masked(scene: SparseScene, silhouettes: Silhouettes) -> SparseScene:
    """Return the scene with found silhouettes as its masks, slightly wider where uncertain.

    Pixels of occluders are excluded.

    Args:
        silhouettes: Masks given by the user are kept as they are, except rejected ones.
    """
    used = by_view(lambda inside: inside > _USED, silhouettes.inside)
    if silhouettes.hidden is not None:
        used = by_view(lambda mask, hidden: mask & ~hidden, used, silhouettes.hidden)
    given = scene.views.masks
    if silhouettes.source == "everything" or (given is not None and torch.equal(used, given)):
        return scene
    return scene.replace(views=scene.views.replace(masks=used))


def of_all_photographs(
    scene: SparseScene, per_pose: ViewPerPose, silhouettes: Silhouettes
) -> tuple[SparseScene, Silhouettes]:
    """Carry silhouettes from one photograph per pose to all photographs of the scene.

    Args:
        silhouettes: In the photographs of ``per_pose``.

    Returns:
        The scene with these silhouettes as masks, see :func:`masked`, and silhouettes of its views.
    """
    if per_pose.scene is not scene:
        silhouettes = silhouettes.take(per_pose.of)
    return masked(scene, silhouettes), silhouettes


def _without_empty(silhouettes: Silhouettes, names: tuple[str, ...]) -> Silhouettes:
    """Mark empty silhouettes as unreliable: with them, the hull of all views would be empty."""
    leave_out("silhouettes.unreliable", ~silhouettes.reliable, names=names)
    empty = silhouettes.reliable & ~by_view(lambda inside: (inside > 0.5).any(), silhouettes.inside)
    leave_out("silhouettes.empty", empty, names=names)
    if not bool(empty.any()):
        return silhouettes
    _warn(empty, names, "its silhouette is empty", "These silhouettes do not constrain the surface")
    return silhouettes.replace(reliable=silhouettes.reliable & ~empty)


def _warn(views: ViewMask, names: tuple[str, ...], reason: str, done: str) -> None:
    skipped(
        *(
            Failure(stage="silhouettes", what="view", name=names[view], reason=reason, done=done)
            for view in views.nonzero()[:, 0].tolist()
        )
    )


def by_session(scene: SparseScene, find: Callable[[SparseScene], Silhouettes]) -> Silhouettes:
    """Find silhouettes in the views of each capture session, and concatenate them.

    Args:
        find: Maps the scene of one session to its silhouettes.

    Returns:
        Silhouettes of all views. If those of one session are everything, everything above all known
        planes.
    """
    if not len(scene.sessions):
        return find(scene)
    views = [(scene.sessions == number).nonzero()[:, 0] for number in torch.unique(scene.sessions)]
    parts = [find(subscene(scene, indices.tolist())) for indices in views]
    unreliable = sum(part.source == "everything" for part in parts)
    leave_out("silhouettes.by_session", unreliable, total=len(parts))
    if unreliable:
        planes = torch.cat([part.planes_world for part in parts])
        return Silhouettes.everything(scene.views, planes)
    order = torch.cat(views).argsort()
    hidden = [part.inside < 0 if part.hidden is None else part.hidden for part in parts]
    expected = [part.expected_overlap for part in parts if part.expected_overlap is not None]
    return parts[0].replace(
        inside=torch.cat([part.inside for part in parts])[order],
        reliable=torch.cat([part.reliable for part in parts])[order],
        hidden=torch.cat(hidden)[order] if any(map(torch.any, hidden)) else None,
        expected_overlap=torch.cat(expected)[order] if len(expected) == len(parts) else None,
    )


def subscene(scene: SparseScene, views: list[int]) -> SparseScene:
    """Return the scene of the chosen views, as a single capture session."""
    kept = torch.zeros(scene.views.num_views, dtype=torch.bool)
    kept[views] = True
    chosen = with_views(scene, kept)
    return chosen.replace(sessions=chosen.sessions[:0])
