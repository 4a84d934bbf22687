"""Which pixels of every view show the object."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from scipy.ndimage import label
from torch import Tensor

from pimper_torch.ground.geometry.supporting_plane import PLANE_TOLERANCE
from pimper_torch.ground.geometry.visual_hull import bounding_box, margins, visual_hull
from pimper_torch.ground.shapes import ViewMask
from pimper_torch.method.silhouettes.cues import Cues, cues_of
from pimper_torch.method.silhouettes.cuts import NUM_VOXELS, Cuts, cut_in_iterations
from pimper_torch.method.silhouettes.given import contradictory
from pimper_torch.method.silhouettes.reliability import (
    MAX_EXPOSED,
    MIN_HELD,
    agreement_of,
    silhouettes_of,
)
from pimper_torch.method.silhouettes.silhouette_config import SilhouetteConfig
from pimper_torch.records import Failure, Silhouettes, SparseScene
from pimper_torch.records.scene import ViewPerPose, with_views
from pimper_torch.runtime.errors import InputError, caution, some
from pimper_torch.runtime.failures import skipped
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import by_view
from pimper_torch.runtime.stage import Stage

# Intersection over union of silhouettes and projections, in the median, below which silhouettes are
# not reliable.
_MIN_OVERLAP = 0.8
_USED = 0.25  # probability above which a pixel is used as the object's
_UNLIKE = "its soft mask lacks most of what the others have in common"
_BY_HULL = "The hull of the other masks stands in for them, and they do not constrain the surface"


class FindSilhouettes(Stage):
    """Find the object's silhouette in every view; a constant to autograd."""

    def __init__(self, config: SilhouetteConfig | None = None) -> None:
        super().__init__()
        self.config = config or SilhouetteConfig()

    @torch.no_grad()
    def forward(self, scene: SparseScene) -> Silhouettes:
        """Find silhouettes, or take the masks for them.

        Returns:
            Everything where that is asked for. A mask that clearly contradicts those of the others
            is not believed: the hull of these stands in for it. Where silhouettes cannot be
            reliable, everything above the plane that the object stands on, or everything where none
            is found, with a :class:`~pimper_torch.runtime.errors.PimperWarning` that says why.
            Where the object was moved between series of photographs, each series is looked at by
            itself.

        Raises:
            InputError: No more than half of the masks agree, or a click meets nothing.
        """
        config, masks = self.config, scene.views.masks
        if config.object == "everything":
            return Silhouettes.everything(scene.views)
        if masks is not None:
            reliable = torch.ones(len(masks), dtype=torch.bool, device=masks.device)
            found = Silhouettes(
                inside=by_view(Tensor.float, masks), reliable=reliable, source="masks"
            ).to(masks.device)
            return self._agreeing(_believed(found, scene.views.names), scene)
        if config.object == "masks":
            raise InputError(
                "`silhouettes.object` is masks, but the photographs come without any. Give a "
                "folder of masks, or let silhouettes be found: `silhouettes.object` auto."
            )
        return by_session(scene, self._found).to(scene.views.images.device)

    def _agreeing(self, silhouettes: Silhouettes, scene: SparseScene) -> Silhouettes:
        """Replace masks that clearly contradict the others by what the hull of these shows."""
        doubted = contradictory(scene).to(silhouettes.reliable.device)
        if not bool(doubted.any()):
            return silhouettes
        if torch.equal(doubted, silhouettes.reliable):
            raise InputError(
                "The masks contradict one another, and no more than half of them agree. Look "
                "whether they show the same object in all photographs, and whether the cameras are "
                "those of these; or leave the masks out."
            )
        _warn(doubted, scene.views.names, "its mask contradicts those of the others", _BY_HULL)
        others = silhouettes.replace(reliable=silhouettes.reliable & ~doubted)
        cameras, box = scene.cameras.to(torch.float32), bounding_box(others, scene.cameras)
        hull = None
        if box is not None:
            hull = visual_hull(others, cameras, box.float(), num_voxels=NUM_VOXELS)
        within = scene.views.inside
        inside = by_view(Tensor.detach, silhouettes.inside)
        for view in doubted.nonzero()[:, 0].tolist():
            # What looks past a photograph's edge once it is undistorted is black.
            inside[view] = within[view] & (scene.views.images[view].detach().amax(dim=0) > 0)
            if hull is not None:
                width, height = (int(side) for side in scene.views.sizes_px[view])
                K, pose = cameras.intrinsics[view], cameras.cam_from_world[view]
                inside[view, :height, :width] *= margins(hull, K, pose, (width, height)) > 0
        return others.replace(inside=inside)

    def _found(self, scene: SparseScene) -> Silhouettes:
        """Find silhouettes in photographs between which the object was not moved."""
        cues = cues_of(scene, self.config)
        cuts, doubt = _cut(cues)
        if doubt and cues.soft is not None and not cues.soft.points:
            # Several things stand apart: the one that cameras look at is likelier than all.
            cuts, doubt = _cut(cues.seed_at_fixation())
        leave_out("silhouettes.disagreement", bool(doubt))
        if cuts is None or doubt:
            above = cues.plane is not None
            what = "above the plane that it stands on" if above else "that the photographs show"
            caution(
                f"Everything {what} is taken for the object: {doubt}. Give masks, or a box round "
                "the object (`silhouettes.region`); `silhouettes.object` everything says that this "
                "is meant.",
                stacklevel=2,
            )
            return Silhouettes.everything(scene.views, _top(cues))
        if missed := _missed(cues, cuts):
            where = some([scene.views.names[view] for view in missed])
            raise InputError(
                f"A click in {where} meets nothing that the silhouettes have in common; needed: a "
                "pixel that shows the object. Choose another by `--object-at`, or give masks that "
                "hold it."
            )
        _warn(cuts.doubted, scene.views.names, _UNLIKE, "It is cut as if it had come without")
        return _believed(silhouettes_of(cuts, scene.views), scene.views.names)


def _cut(cues: Cues) -> tuple[Cuts | None, str]:
    """Cut all views, and state why the cuts are unreliable, or nothing."""
    cuts = None
    if cues.agreement is not None or cues.has_points or cues.soft is not None:
        cuts = cut_in_iterations(cues)
    if cuts is None:
        return None, "the views' silhouettes have nothing in common"
    return cuts, _doubt(cuts)


def _missed(cues: Cues, cuts: Cuts) -> list[int]:
    """List the views in which something is pointed at that neither cut nor hull shows."""
    missed = []
    for view, pixels in enumerate(cues.soft.seeds_px if cues.soft else ()):
        column, row = pixels.long().unbind(dim=1)
        pointed = torch.zeros_like(cuts.masks[view])
        pointed[row, column] = True
        shown = cuts.masks[view] | (cuts.margins_px[view] > 0)
        clicks, count = label(pointed.numpy(), structure=[[1] * 3] * 3)
        if len(set(clicks[(pointed & shown).numpy()].tolist())) < count:
            missed.append(view)
    return missed


def _top(cues: Cues) -> Float[Tensor, "plane 4"] | None:
    """Return the upper side of the supporting plane, as thick as its points are rough."""
    if cues.plane is None:
        return None
    thickness = PLANE_TOLERANCE * cues.fixation.distance
    height = cues.plane.offset + thickness
    return torch.cat([cues.plane.normal_world, -height.reshape(1)])[None]


def _doubt(cuts: Cuts) -> str:
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
            f"silhouettes show what is behind the object on {exposed:.0%} of their pixels in "
            f"the median; at most: {MAX_EXPOSED:.0%}"
        )
    if held < MIN_HELD:
        return (
            f"silhouettes hold {held:.0%} of the object's points in the median; needed: "
            f"{MIN_HELD:.0%}"
        )
    if int(reliable.sum()) < max(3, len(reliable) / 2):
        return f"only {int(reliable.sum())} of {len(reliable)} silhouettes agree with the others"
    return ""


def masked(scene: SparseScene, silhouettes: Silhouettes) -> SparseScene:
    """Return the scene with silhouettes that were found for masks, a little wider where unsure.

    What hides the object is left out.

    Args:
        silhouettes: Where they are masks that a person gave, those stay as they are, but for masks
            that were not believed.
    """
    used = by_view(lambda inside: inside > _USED, silhouettes.inside)
    if silhouettes.hidden is not None:
        used = by_view(lambda one, hidden: one & ~hidden, used, silhouettes.hidden)
    given = scene.views.masks
    if silhouettes.source == "everything" or (given is not None and torch.equal(used, given)):
        return scene
    return scene.replace(views=scene.views.replace(masks=used))


def of_all_photographs(
    scene: SparseScene, few: ViewPerPose, found: Silhouettes
) -> tuple[SparseScene, Silhouettes]:
    """Carry silhouettes of one photograph a pose to all photographs of the scene.

    Args:
        found: In the photographs of ``few``.

    Returns:
        The scene with these silhouettes for masks, see :func:`masked`, and silhouettes of its
        views.
    """
    if few.scene is not scene:
        found = found.take(few.of)
    return masked(scene, found), found


def _believed(silhouettes: Silhouettes, names: tuple[str, ...]) -> Silhouettes:
    """Take empty silhouettes for unreliable: the hull of all views would be empty."""
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
    """Find silhouettes in the views of each series, and put them side by side.

    Args:
        find: From the scene of one series to its silhouettes.

    Returns:
        Of all views. Where those of one series are everything, everything above every known plane.
    """
    if not len(scene.sessions):
        return find(scene)
    views = [(scene.sessions == number).nonzero()[:, 0] for number in torch.unique(scene.sessions)]
    found = [find(part(scene, one.tolist())) for one in views]
    doubtful = sum(one.source == "everything" for one in found)
    leave_out("silhouettes.by_session", doubtful, total=len(found))
    if doubtful:
        planes = torch.cat([one.planes_world for one in found])
        return Silhouettes.everything(scene.views, planes)
    order = torch.cat(views).argsort()
    hidden = [one.inside < 0 if one.hidden is None else one.hidden for one in found]
    return found[0].replace(
        inside=torch.cat([one.inside for one in found])[order],
        reliable=torch.cat([one.reliable for one in found])[order],
        hidden=torch.cat(hidden)[order] if any(map(torch.any, hidden)) else None,
    )


def part(scene: SparseScene, views: list[int]) -> SparseScene:
    """Return the scene of some views, as if the object had stood there alone."""
    kept = torch.zeros(scene.views.num_views, dtype=torch.bool)
    kept[views] = True
    some = with_views(scene, kept)
    return some.replace(sessions=some.sessions[:0])
