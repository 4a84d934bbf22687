"""A COLMAP model that the photographs come with."""

from pathlib import Path

import torch

from pimper_torch.errors import InputError, ReconstructionError
from pimper_torch.records import Views
from pimper_torch.sfm import colmap
from pimper_torch.sfm.model import SparseModel, match_names


def existing_model(views: Views, folder: Path) -> SparseModel:
    """Read a COLMAP model and put it in the photographs' order and sizes.

    Args:
        views: Matched by file name; the model's cameras may have been made from photographs of
            another size.
        folder: Of the model.

    Raises:
        ReconstructionError: The model holds fewer than 3 of the photographs.
        InputError: It does not belong to the photographs, or cannot be read.
    """
    model = match_names(colmap.read_model(folder), views.names, folder)
    if model.num_views < 3:
        raise ReconstructionError(
            f"The COLMAP model in {folder} holds {model.num_views} of {views.num_views} "
            f"photographs ({', '.join(model.names)}); at least 3 are needed. Use a model that "
            "holds more of them, or leave it out to run structure from motion."
        )
    return _follow_resize(model, views)


def _follow_resize(model: SparseModel, views: Views) -> SparseModel:
    sizes = dict(zip(views.names, views.sizes_px.tolist(), strict=True))
    lenses, scales = [], []
    cameras: dict[tuple[int, int, int], int] = {}
    fresh = 1 + max(lens.camera for lens in model.lenses)
    for name, lens in zip(model.names, model.lenses, strict=True):
        width, height = sizes[name]
        scale = width / lens.width, height / lens.height
        # Rounding a side to whole pixels changes the shape by less than this.
        if abs(scale[0] / scale[1] - 1) > max(0.01, 2 / min(width, height)):
            raise InputError(
                f"{name} is {width}x{height}, but the COLMAP model's camera for it is "
                f"{lens.width}x{lens.height}, which is another shape. Give the photographs the "
                "model was made from, resized if you like, but neither cropped nor turned."
            )
        # Photographs of one camera that were resized differently no longer share it; the
        # first of them keep its number.
        known = {number for number, *_ in cameras}
        if lens.camera not in known:
            cameras[lens.camera, width, height] = lens.camera
        camera = cameras.setdefault((lens.camera, width, height), fresh + len(cameras))
        lenses.append(colmap.rescale_lens(lens, width, height).replace(camera=camera))
        scales.append(scale)
    factors = torch.tensor(scales, dtype=torch.float64)
    return model.replace(
        lenses=tuple(lenses),
        observation_pixels=model.observation_pixels * factors[model.observation_view],
    )
