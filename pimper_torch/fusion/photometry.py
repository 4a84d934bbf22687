"""What fusion asks of the photometry it is handed."""

from jaxtyping import Bool
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.records import PhotometricPatches, Templates


def check_photometry(photometric: PhotometricPatches) -> None:
    """Check that normals face the viewer and confidences are what they claim.

    Raises:
        InputError: A valid normal faces away from the viewer or is not finite, or a
            confidence lies outside [0, 1].
    """
    pairs = zip(photometric.patches.buckets, photometric.buckets, strict=True)
    for templates, found in pairs:
        away = found.valid & ~(found.normals_patch[..., 2] < 0)
        away |= found.valid & ~found.normals_patch.isfinite().all(dim=-1)
        if bool(away.any()):
            raise InputError(
                f"fuse: {int(away.sum())} of {int(found.valid.sum())} valid normals of a bucket "
                f"face away from the viewer or are not finite, most of them on facet "
                f"{_worst(templates, away)}; needed: n_z < 0 in the patch frame (x right, y down, "
                "z into the surface). Turn them round, or set their samples not valid."
            )
        share = found.confidence
        wrong = ~((share >= 0) & (share <= 1))
        if bool(wrong.any()):
            raise InputError(
                f"fuse: {int(wrong.sum())} confidences of a bucket lie outside [0, 1], such as "
                f"{float(share.detach()[wrong][0]):.4g}, most of them on facet "
                f"{_worst(templates, wrong)}. Divide by the largest, or clamp them: 1 is a normal "
                "known without error, 0.5 one that is off by the angle `HALF_CONFIDENCE_DEG` of "
                "photometry/certainty.py."
            )


def _worst(templates: Templates, wrong: Bool[Tensor, "patch height width"]) -> int:
    """Name the facet with most samples that are wrong."""
    return int(templates.facet[wrong.flatten(1).sum(dim=1).argmax()])
