"""Models grown from verified matches."""

import tempfile
from dataclasses import dataclass
from itertools import count

from pimper_torch.progress import report
from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.colmap import model_of
from pimper_torch.sfm.model import SparseModel
from pimper_torch.sfm.workspace import Workspace

# Growth of a model between two adjustments of all of it. COLMAP's own 1.1 suits models that are
# final, and takes 29 in place of 25 CPU s on 66 photographs; here tracks are found again, and
# everything is adjusted to them.
_GROWTH = 1.2


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSettings:
    """How views are added to a model.

    Attributes:
        min_inliers: Points of the model that a new view must see.
        pairs_count: Points that only two views see take part, too: they tie views with
            little overlap, less exactly.
    """

    min_inliers: int
    pairs_count: bool
    seed: int


def map_views(space: Workspace, settings: MapSettings) -> list[SparseModel]:
    """Grow models from the best pair of views on, until no view can be added.

    On one thread, so that the same matches give the same bits.

    Returns:
        One model a component, the one with most views first. Names are files of ``space``.
    """
    pycolmap = loaded()

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.extract_colors = False
    options.num_threads = 1
    options.random_seed = settings.seed
    options.mapper.abs_pose_min_num_inliers = settings.min_inliers
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.triangulation.ignore_two_view_tracks = not settings.pairs_count
    registered = count(3)  # the first call follows a model of two views

    def tell() -> None:
        # Of a model that begins anew, more views than there are can have been added.
        report(min(next(registered), len(space.files)), len(space.files))

    with tempfile.TemporaryDirectory(dir=space.folder) as output, quiet():
        found = pycolmap.incremental_mapping(
            space.database, space.images, output, options, next_image_callback=tell
        )
    models = [model_of(reconstruction) for reconstruction in found.values()]
    return sorted(models, key=lambda model: (-model.num_views, -len(model.points_world)))
