"""Results of a run in numbers: lights and the summary, ready for JSON."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.doors.io.version import installed_version
from pimper_torch.ground.geometry.rigid import rotate
from pimper_torch.published.seams import by_facet
from pimper_torch.records import Failure, Reconstruction, Relighting

# What JSON can hold.
Report = dict[str, object]


def write_json(report: Mapping[str, object], path: Path | str, indent: int | None = 2) -> None:
    """Write numbers and texts, none of which may be NaN or infinite."""
    text = json.dumps(report, indent=indent, allow_nan=False, ensure_ascii=False)
    Path(path).write_text(text + "\n", encoding="utf-8")


def lights_report(result: Reconstruction) -> Report:
    """Report the light of every view, for each patch and for all of them together.

    Lights are first-order harmonics ``l`` in the world frame: radiance is
    ``albedo * (l[0] + l[1:] . n)`` with ``n`` the outward unit normal. A patch that a view
    does not have is ``null`` there. A view's one light leaves out such patches, and those
    whose light varied too little for a factorization; see :func:`common_lights`.
    """
    facets, lights_world, determined = world_lights(result)
    lit = (lights_world != 0).any(dim=-1)
    common, counts = common_lights(result)
    views = result.scene.views.names
    return {
        "reference": views[result.coarse.reference],
        "model": "radiance = albedo * (l[0] + l[1:] . n), world frame, n outward",
        "views": [
            {
                "name": name,
                "light": _rounded(common[index]) if counts[index] > 0 else None,
                "patches": int(counts[index]),
            }
            for index, name in enumerate(views)
        ],
        "patches": [
            {
                "facet": int(facet),
                "determined": bool(known),
                "lights": [
                    _rounded(light) if bool(there) else None
                    for light, there in zip(lights, here, strict=True)
                ],
            }
            for facet, known, lights, here in zip(
                facets, determined, lights_world, lit, strict=True
            )
        ],
    }


def common_lights(result: Reconstruction) -> tuple[Float[Tensor, "view 4"], Int[Tensor, " view"]]:
    r"""Find the one light of every view that shades all patches most nearly as their own do.

    A patch that is nearly flat determines its light only along its normal, so lights are weighted
    by what they were determined from: minimised is :math:`\sum_p \sum_s \rho_s^2 ((l - l_p)
    \cdot (1, n_s))^2` over the valid samples. What they leave open together is the mean's.

    Returns:
        The lights, world frame, and of how many patches each is; zero where of none.
    """
    _, lights_world, determined = world_lights(result)
    counted = ((lights_world != 0).any(dim=-1) & determined[:, None]).double()
    counts = counted.sum(dim=0)
    lights = lights_world.double()
    mean = (lights * counted[..., None]).sum(dim=0) / counts[:, None].clamp_min(1)
    weight = _determined_by(result)
    known = torch.einsum("pij,pv->vij", weight, counted)
    regularization = torch.einsum("pij,pvj->vi", weight, counted[..., None] * (lights - mean))
    # What samples see with a millionth of the best seen direction is left open.
    step = torch.linalg.pinv(known, rtol=1e-6, hermitian=True) @ regularization[..., None]
    return (mean + step[..., 0]).to(lights_world), counts.long()


def _determined_by(result: Reconstruction) -> Float[Tensor, "patch 4 4"]:
    """Sum ``rho^2 (1, n) (1, n)^T`` over each patch's samples, world frame, order of facets."""
    photometric = result.patches.photometric
    sums = []
    for templates, found in zip(photometric.patches.buckets, photometric.buckets, strict=True):
        weight = found.albedo.double().mean(dim=-1).square() * found.valid
        normals = rotate(templates.patch_from_world.mT, found.normals_patch.flatten(1, 2)).double()
        shading = torch.cat([torch.ones_like(normals[..., :1]), normals], dim=-1)
        sums.append(shading.mT @ (weight.flatten(1)[..., None] * shading))
    return by_facet(photometric.patches, sums)


def world_lights(
    result: Reconstruction,
) -> tuple[Int[Tensor, " patch"], Float[Tensor, "patch view 4"], Bool[Tensor, " patch"]]:
    """Turn the lights of all patches to the world frame.

    ``l . (1, R n) = (l_0, R^T l_xyz) . (1, n)`` for ``R`` from world to patch.

    Returns:
        In the order of the facets: the facet, its lights, whether they were determined.
    """
    patches, buckets = result.patches.photometric.patches, result.patches.photometric.buckets
    lights = []
    for templates, found in zip(patches.buckets, buckets, strict=True):
        world_from_patch = templates.patch_from_world.mT  # only its rotation is used
        directed = rotate(world_from_patch, found.lights_patch[..., 1:4])
        own = torch.cat([found.lights_patch[..., :1], directed], dim=-1)
        lights.append(templates.among_all(own))
    facets = by_facet(patches, (templates.facet for templates in patches.buckets))
    determined = by_facet(patches, (found.determined for found in buckets))
    return facets, by_facet(patches, lights), determined


def summary_report(result: Reconstruction, about: Mapping[str, object]) -> Report:
    """Count what went in and came out, and what every stage cost.

    Args:
        about: More entries, such as the folder of the photographs.
    """
    scene = result.scene
    figures = {key: value for report in result.report for key, value in report.figures.items()}
    samples, missing = figures.get("samples"), figures.get("missing_samples", 0)
    buckets = result.patches.photometric.buckets
    ends = [bucket.convergence for bucket in buckets]
    patches = sum(len(end.converged) for end in ends)
    undetermined = sum(int((~bucket.determined).sum()) for bucket in buckets)
    # Peaks are of the process so far: the first that reaches the highest raised it.
    peak = max(result.report, key=lambda report: report.peak_memory_mb, default=None)
    return {
        "pimper_torch": installed_version(),
        **about,
        "reference": scene.views.names[result.coarse.reference],
        "views": scene.views.num_views + len(scene.unregistered),
        "registered": scene.views.num_views,
        "unregistered": list(scene.unregistered),
        "diagnosis": scene.diagnosis or None,
        "doubt": scene.diagnosis or None,  # its name until 0.9
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
    """List failures of one kind and reason together, by the names of what failed."""
    names: dict[tuple[str, str, str, str], list[str]] = {}
    for each in failures:
        names.setdefault((each.stage, each.what, each.reason, each.done), []).append(each.name)
    return [
        {"stage": stage, "what": what, "names": some, "reason": reason, "done": done}
        for (stage, what, reason, done), some in names.items()
    ]


def _finite(value: float | int) -> float | int | None:
    return value if math.isfinite(value) else None


def _rounded(light: Float[Tensor, " 4"]) -> list[float | None]:
    """Keep six digits, more than any photograph determines."""
    return [_finite(float(f"{value:.6g}")) for value in light.tolist()]


def relighting_report(found: Relighting) -> dict[str, object]:
    """Return the entry ``relighting`` of ``summary.json``: lights and materials."""
    vertices = torch.bincount(found.materials.cluster, minlength=len(found.materials.metallic))
    shares = (vertices / vertices.sum()).tolist()
    rows = zip(shares, found.materials.values.tolist(), strict=True)
    decibels = [one.psnr_db.tolist() for one in (found.errors, found.matte)]
    errors = zip(found.errors.names, *decibels, strict=True)
    return {
        "photographs": "held out" if found.held_out else "used",
        "psnr_db": _mean(found.errors.psnr_db),
        "psnr_matte_db": _mean(found.matte.psnr_db),
        "psnr_textured_db": None if found.textured is None else _mean(found.textured.psnr_db),
        "views": [
            {
                "name": name,
                "psnr_db": _finite(round(with_one, 3)),
                "psnr_matte_db": _finite(round(without, 3)),
            }
            for name, with_one, without in errors
        ],
        "materials": [
            {"vertices": share, "metallic": metal, "roughness": rough, "specular": specular}
            for share, (metal, rough, specular) in rows
        ],
    }


def _mean(values: Float[Tensor, " view"]) -> float | None:
    return _finite(round(float(values.nanmean()), 3))
