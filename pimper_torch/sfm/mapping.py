"""Models grown from verified matches."""

import tempfile
from itertools import count

from pimper_torch.progress import report
from pimper_torch.sfm.binding import loaded, quiet
from pimper_torch.sfm.colmap import model_of
from pimper_torch.sfm.matching import MOST_PAIRED
from pimper_torch.sfm.model import SparseModel
from pimper_torch.sfm.reconstruct_config import MIN_POINTS
from pimper_torch.sfm.workspace import Workspace

# Growth of a model between two adjustments of all of it. COLMAP's own 1.1 suits models that are
# final, and takes 29 in place of 25 CPU s on 66 photographs; here tracks are found again, and
# everything is adjusted to them.
_GROWTH = 1.2
# The same for many photographs, and the relative fall of the cost that ends an adjustment: half of
# the CPU seconds, with the same cameras after tracks are found again; see docs/decisions.md.
_MANY_GROWTH, _MANY_TOLERANCE = 1.4, 1e-4


def map_views(space: Workspace, seed: int, *, pairs_count: bool = False) -> list[SparseModel]:
    """Grow models from the best pair of views on, until no view can be added.

    On one thread, so that the same matches give the same bits.

    Args:
        pairs_count: Points that only two views see take part, too: they tie views with
            little overlap, less exactly.

    Returns:
        One model a component, the one with most views first. Names are files of ``space``.
    """
    pycolmap = loaded()

    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 3
    options.extract_colors = False
    options.num_threads = 1
    options.random_seed = seed
    options.mapper.abs_pose_min_num_inliers = MIN_POINTS
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.triangulation.ignore_two_view_tracks = not pairs_count
    if len(space.files) > MOST_PAIRED:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = _MANY_GROWTH
        options.ba_global_max_refinements, options.ba_local_max_refinements = 2, 1
        options.ba_global_function_tolerance = _MANY_TOLERANCE
        options.ba_local_function_tolerance = _MANY_TOLERANCE
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
