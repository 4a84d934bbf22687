"""The stage that says whether a result is good, and if not, why."""

import re
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pimper_torch.geometry.coverage import coverage_by
from pimper_torch.records import Mesh, Reconstruction, SilhouetteCoverage, Silhouettes, Verdict
from pimper_torch.runtime.reporting import add_counts
from pimper_torch.stages.stage import Stage
from pimper_torch.stages.verdict.sides import unphotographed

# Values of each figure that score 0, a half and 1: unusable, the last of good results, and best.
# Fitted to ten captures of the fleet and the demo: docs/decisions.md, "The verdict".
LIMITS = {
    "registered": (0.2, 0.7, 1.0),
    "reliable": (0.2, 0.7, 1.0),
    "expected_overlap": (0.6, 0.855, 1.0),
    "covered": (0.7, 0.96, 1.0),
    "sticking_out": (0.3, 0.045, 0.0),
    "predicted_db": (12.0, 23.0, 40.0),
    "determined": (0.0, 0.4, 1.0),
}

# The worst view counts this much: it may lack 10 % of its silhouette where the mean may lack 4 %.
# The worst views of plain sets lack up to 0.08 (potatoes, 12 views of 320x240, fast).
_WORST = 0.4
_MASKS = "Check masks/, correct them, and give them by `--masks`."


class Judge(Stage):
    """Compare figures of a run with those of good results. Not differentiable."""

    kept_as = Verdict

    @torch.no_grad()
    def forward(self, result: Reconstruction) -> Verdict:
        """Return the verdict, which is that of the least favourable figure.

        Args:
            result: With its relighting, if it has one, the prediction of photographs counts.
        """
        figures = {each.name: each for each in _figures(result)}
        scores = {name: score_of(name, each.value) for name, each in figures.items()}
        worst = figures[min(scores, key=lambda name: scores[name])]
        score = scores[worst.name]
        if result.scene.diagnosis:
            return Verdict(score=0.0, text=f"Not usable: {result.scene.diagnosis}", scores=scores)
        if score >= 0.5:
            text = f"Good: {_praise(result)}."
        else:
            word = f"Look at {worst.photograph}" if score > 0 else "Not usable"
            text = f"{word}: {worst.reason}. {worst.advice}"
        return Verdict(score=score, text=text, scores=scores)


class _Figure(NamedTuple):
    """A figure of a run, and the sentences that are said if it is bad."""

    name: str
    value: float
    photograph: str
    reason: str
    advice: str


def _praise(result: Reconstruction) -> str:
    """Return what a good result is made of, how accurate it should be, and what it lacks."""
    mesh, count = result.mesh, len(result.scene.views.names)
    text = f"from {count} of {count + len(result.scene.unregistered)} photographs"
    if mesh.expected_error is not None:
        extent = (mesh.vertices_world.amax(dim=0) - mesh.vertices_world.amin(dim=0)).norm()
        text += (
            f", with an expected error of {mesh.expected_error.median() / extent:.2%} of the extent"
        )
    everything = result.silhouettes.source == "everything"  # has no sides
    if sides := [] if everything else unphotographed(mesh, result.cameras):
        verb = "was" if len(sides) == 1 else "were"
        text += f"; {' and '.join(f'the {side}' for side in sides)} {verb} not photographed"
    return text


def in_unit(text: str, mesh: Mesh, unit: str) -> str:
    """Return the text of a verdict with the expected error also in the unit of the scaled mesh."""
    if mesh.expected_error is None:
        return text
    error = f"{float(f'{mesh.expected_error.median():.2g}'):g} {unit}"
    return re.sub(r"(?<=expected error of )\S+ of the extent", rf"{error} (\g<0>)", text)


def score_of(name: str, value: float) -> float:
    """Return the score of a figure, linear between its :data:`LIMITS`."""
    limits = LIMITS[name]
    sign = 1 if limits[0] < limits[-1] else -1
    return float(np.interp(sign * value, [sign * limit for limit in limits], [0, 0.5, 1]))


def _figures(result: Reconstruction) -> Iterator[_Figure]:
    """Yield the figures that the run determines."""
    scene, silhouettes, relighting = result.scene, result.silhouettes, result.relighting
    names, reference = scene.views.names, scene.views.names[result.coarse.reference]
    if (lost := scene.unregistered) and not scene.given:
        yield _Figure(
            "registered",
            len(names) / len(names + lost),
            lost[0],
            f"{len(lost)} of {len(names + lost)} photographs were not registered",
            "Photograph the object from places between, or remove photographs of other things.",
        )
    if silhouettes.source != "everything" and bool(silhouettes.reliable.any()):
        found = coverage_by(result.mesh, silhouettes, result.cameras)
        add_counts(found.figures())
        yield from _of_silhouettes(silhouettes, found, names)
    buckets = result.patches.photometric.buckets
    patches = max(1, sum(len(bucket.determined) for bucket in buckets))
    determined = sum(int(bucket.determined.sum()) for bucket in buckets) / patches
    yield _Figure(
        "determined",
        determined,
        reference,
        f"light determines the normals of only {determined:.0%} of the facets",
        "Photograph the object under more, and more different, lights.",
    )
    if relighting is not None and bool(relighting.errors.psnr_db.isfinite().any()):
        errors = relighting.errors
        mean, worst = errors.psnr_db.nanmean(), errors.psnr_db.nan_to_num(torch.inf).argmin()
        yield _Figure(
            "predicted_db",
            float(mean),
            errors.names[int(worst)],
            f"the surface predicts the photographs only with a PSNR of {mean:.0f} dB",
            "Compare it with its prediction in report.html.",
        )


def _of_silhouettes(
    silhouettes: Silhouettes, found: SilhouetteCoverage, names: tuple[str, ...]
) -> Iterator[_Figure]:
    """Yield the figures of silhouettes, and of the surface against them."""

    def worst(values: Tensor, views: Tensor) -> str:
        return names[int(views[values.argmax()])]

    reliable, overlap = silhouettes.reliable, silhouettes.expected_overlap
    advice = "Correct the given masks." if silhouettes.source == "masks" else _MASKS
    count, every = int(reliable.sum()), torch.arange(len(reliable), device=reliable.device)
    trusted = reliable.nonzero()[:, 0]
    yield _Figure(
        "reliable",
        count / len(reliable),
        worst((~reliable).int(), every),
        f"{len(reliable) - count} of {len(reliable)} silhouettes contradict the others",
        advice,
    )
    if overlap is not None:
        yield _Figure(
            "expected_overlap",
            float(overlap.mean()),
            worst(-overlap, every),
            f"the silhouettes are expected to overlap the object by only {overlap.mean():.0%}",
            advice,
        )
    lacking, exceeding = ((x.mean(), x.max()) for x in (found.uncovered, found.outside))
    yield _Figure(
        "covered",
        1 - float(torch.maximum(lacking[0], _WORST * lacking[1])),
        worst(found.uncovered, trusted),
        f"the surface lacks {lacking[1]:.0%} of the silhouette, and {lacking[0]:.0%} in the mean",
        "Photograph what is missing from more places, or check masks/.",
    )
    yield _Figure(
        "sticking_out",
        float(torch.maximum(exceeding[0], _WORST * exceeding[1])),
        worst(found.outside, trusted),
        f"the surface sticks out of the silhouette by {exceeding[1]:.0%} of its area, and by "
        f"{exceeding[0]:.0%} in the mean",
        advice,
    )
