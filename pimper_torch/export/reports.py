"""Lights and summary of a run, as content of JSON files."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.geometry.rigid import rotate
from pimper_torch.io.version import installed_version
from pimper_torch.paper.seams import per_facet
from pimper_torch.records import Failure, Reconstruction, Relighting

Report = dict[str, object]  # a JSON object


def write_json(report: Mapping[str, object], path: Path | str, indent: int | None = 2) -> None:
    """Write a JSON file; ``ValueError`` for numbers that are NaN or infinite."""
    text = json.dumps(report, indent=indent, allow_nan=False, ensure_ascii=False)
    Path(path).write_text(text + "\n", encoding="utf-8")


def lights_report(result: Reconstruction) -> Report:
    """Return the content of ``lights.json``: the light of every view, per patch and in common.

    Lights are first-order harmonics ``l`` in the world frame: radiance is
    ``albedo * (l[0] + l[1:] . n)`` with ``n`` the outward unit normal. The light is ``null`` for a
    patch without samples in the view. The common light of a view excludes such patches, and
    those with too little variation of the light for a factorization; see :func:`common_lights`.
    """
    common, counts = (values.tolist() for values in common_lights(result))
    views = result.scene.views.names
    return {
        "reference": views[result.coarse.reference],
        "model": "radiance = albedo * (l[0] + l[1:] . n), world frame, n outward",
        "views": [
            {
                "name": name,
                "light": _rounded(common[index]) if counts[index] > 0 else None,
                "patches": counts[index],
            }
            for index, name in enumerate(views)
        ],
        "patches": [
            {
                "facet": facet,
                "determined": is_determined,
                "lights": [_rounded(light) if any(light) else None for light in lights],
            }
            for facet, lights, is_determined in zip(
                *(values.tolist() for values in world_lights(result)), strict=True
            )
        ],
    }


def common_lights(result: Reconstruction) -> tuple[Float[Tensor, "view 4"], Int[Tensor, " view"]]:
    r"""Return the light of every view that best reproduces the shading of its patches' lights.

    A patch that is nearly flat determines its light only along its normal, so the fit minimizes
    :math:`\sum_p \sum_s \rho_s^2 ((l - l_p) \cdot (1, n_s))^2` over the valid samples. Components
    that these do not determine are those of the mean light.

    Returns:
        The lights in the world frame, and the number of patches of each; zero without patches.
    """
    _, lights_world, determined = world_lights(result)
    counted = ((lights_world != 0).any(dim=-1) & determined[:, None]).double()
    counts = counted.sum(dim=0)
    lights = lights_world.double()
    mean = (lights * counted[..., None]).sum(dim=0) / counts[:, None].clamp_min(1)
    weight = _normal_matrices(result)
    matrix = torch.einsum("pij,pv->vij", weight, counted)
    residual = torch.einsum("pij,pvj->vi", weight, counted[..., None] * (lights - mean))
    # Directions with less than a millionth of the largest eigenvalue are undetermined.
    step = torch.linalg.pinv(matrix, rtol=1e-6, hermitian=True) @ residual[..., None]
    return (mean + step[..., 0]).to(lights_world), counts.long()


def _normal_matrices(result: Reconstruction) -> Float[Tensor, "patch 4 4"]:
    """Sum ``rho^2 (1, n) (1, n)^T`` over samples of each patch, world frame, in facet order."""
    photometric = result.patches.photometric
    sums = []
    for templates, bucket in zip(photometric.patches.buckets, photometric.buckets, strict=True):
        weight = bucket.albedo.double().mean(dim=-1).square() * bucket.valid
        normals = rotate(templates.patch_from_world.mT, bucket.normals_patch.flatten(1, 2)).double()
        shading = torch.cat([torch.ones_like(normals[..., :1]), normals], dim=-1)
        sums.append(shading.mT @ (weight.flatten(1)[..., None] * shading))
    return per_facet(photometric.patches, sums)


def world_lights(
    result: Reconstruction,
) -> tuple[Int[Tensor, " patch"], Float[Tensor, "patch view 4"], Bool[Tensor, " patch"]]:
    """Return the lights of all patches in the world frame.

    ``l . (1, R n) = (l_0, R^T l_xyz) . (1, n)`` for ``R`` from world to patch.

    Returns:
        In the order of facets: the facets, their lights, whether these were determined.
    """
    patches, buckets = result.patches.photometric.patches, result.patches.photometric.buckets
    lights = []
    for templates, bucket in zip(patches.buckets, buckets, strict=True):
        world_from_patch = templates.patch_from_world.mT  # only its rotation is used
        directed = rotate(world_from_patch, bucket.lights_patch[..., 1:4])
        rotated = torch.cat([bucket.lights_patch[..., :1], directed], dim=-1)
        lights.append(templates.among_all(rotated))
    facets = per_facet(patches, (templates.facet for templates in patches.buckets))
    determined = per_facet(patches, (bucket.determined for bucket in buckets))
    return facets, per_facet(patches, lights), determined


def summary_report(result: Reconstruction, about: Mapping[str, object]) -> Report:
    """Return ``summary.json``: sizes of inputs and results, and figures of every stage.

    Args:
        about: Additional entries, such as the folder of the photographs.
    """
    scene = result.scene
    figures = {key: value for report in result.report for key, value in report.figures.items()}
    samples, missing = figures.get("samples"), figures.get("missing_samples", 0)
    buckets = result.patches.photometric.buckets
    ends = [bucket.convergence for bucket in buckets]
    patches = sum(len(end.converged) for end in ends)
    undetermined = sum(int((~bucket.determined).sum()) for bucket in buckets)
    # Peaks are cumulative: the first stage with the highest peak caused it.
    peak = max(result.report, key=lambda report: report.peak_memory_mb, default=None)
    return {
        "pimper_torch": installed_version(),
        **about,
        "reference": scene.views.names[result.coarse.reference],
        "views": scene.views.num_views + len(scene.unregistered),
        "registered": scene.views.num_views,
        "unregistered": list(scene.unregistered),
        "diagnosis": scene.diagnosis or None,
        "doubt": scene.diagnosis or None,  # the name until version 0.9
        "offset_world": list(scene.offset_world),
        "failures": _failures(result.failures),
        "left_out": [asdict(entry) for entry in result.left_out],
        "sparse_points": len(scene.points_world),
        "mesh_points": len(result.coarse.mesh.vertices_world),
        "triangles": len(result.coarse.mesh.faces),
        "samples": samples,
        "missing_fraction": missing / samples if samples else None,
        "undetermined_fraction": undetermined / max(1, patches),
        "vertices": len(result.mesh.vertices_world),
        "faces": len(result.mesh.faces),
        "seconds": sum(report.seconds for report in result.report),
        "peak_memory_mb": None if peak is None else peak.peak_memory_mb,
        "peak_memory_stage": None if peak is None else peak.name,
        "convergence": {
            "patches": patches,
            "converged": sum(int(end.converged.sum()) for end in ends),
            "mean_iterations": sum(float(end.iterations.sum()) for end in ends) / max(1, patches),
        },
        "stages": [
            {
                "name": report.name,
                "seconds": report.seconds,
                "peak_memory_mb": report.peak_memory_mb,
                "kept": report.kept,
                **{key: _finite(value) for key, value in report.figures.items()},
            }
            for report in result.report
        ],
    }


def _failures(failures: Sequence[Failure]) -> list[Report]:
    """Group failures with the same kind and reason, and list the names of each group."""
    names: dict[tuple[str, str, str, str], list[str]] = {}
    for each in failures:
        names.setdefault((each.stage, each.what, each.reason, each.done), []).append(each.name)
    return [
        {"stage": stage, "what": what, "names": group, "reason": reason, "done": done}
        for (stage, what, reason, done), group in names.items()
    ]


def _finite(value: float | int) -> float | int | None:
    return value if math.isfinite(value) else None


def _rounded(light: Sequence[float]) -> list[float | None]:
    """Round to six digits, more than photographs determine."""
    return [_finite(float(f"{value:.6g}")) for value in light]


def relighting_report(fit: Relighting) -> dict[str, object]:
    """Return the entry ``relighting`` of ``summary.json``: prediction errors and materials."""
    vertices = torch.bincount(fit.materials.cluster, minlength=len(fit.materials.metallic))
    shares = (vertices / vertices.sum()).tolist()
    rows = zip(shares, fit.materials.values.tolist(), strict=True)
    decibels = [errors.psnr_db.tolist() for errors in (fit.errors, fit.matte)]
    errors = zip(fit.errors.names, *decibels, strict=True)
    return {
        "photographs": "held out" if fit.held_out else "used",
        "psnr_db": _mean(fit.errors.psnr_db),
        "psnr_matte_db": _mean(fit.matte.psnr_db),
        "psnr_textured_db": None if fit.textured is None else _mean(fit.textured.psnr_db),
        "views": [
            {
                "name": name,
                "psnr_db": _finite(round(psnr, 3)),
                "psnr_matte_db": _finite(round(matte, 3)),
            }
            for name, psnr, matte in errors
        ],
        "materials": [
            {"vertices": share, "metallic": metal, "roughness": rough, "specular": specular}
            for share, (metal, rough, specular) in rows
        ],
    }


def _mean(values: Float[Tensor, " view"]) -> float | None:
    return _finite(round(float(values.nanmean()), 3))
