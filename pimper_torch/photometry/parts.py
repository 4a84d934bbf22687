"""Buckets cut into parts that fit the cache, and what was found for them put together."""

from dataclasses import dataclass

import torch

from pimper_torch.photometry.bilinear import select
from pimper_torch.records import Convergence, PatchViews, Photometry, Record

# Patches are factorized so many entries of J at a time, or one by one: what they need fits the
# cache.
PART_ENTRIES = 400_000


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Part(Record):
    """Some patches of a bucket, in a record of their own."""

    bucket: int
    seen: PatchViews


def parts_of(seen: PatchViews, bucket: int) -> list[Part]:
    """Cut a bucket into batches of bounded size, as views of its memory."""
    templates, registered = seen.patches.buckets[bucket], seen.buckets[bucket]
    count, num_views = registered.valid.shape[:2]
    samples = max(int(templates.inside.sum(dim=(1, 2)).max()), 1) if count else 1
    size = max(1, PART_ENTRIES // (samples * max(num_views, 1)))
    parts = []
    for first in range(0, max(count, 1), size):
        some = slice(first, first + size)
        patches = seen.patches.replace(buckets=(select(templates, some),))
        part = PatchViews(patches=patches, buckets=(select(registered, some),))
        parts.append(Part(bucket=bucket, seen=part))
    return parts


def joined_parts(parts: list[Photometry]) -> Photometry:
    """Put the parts of a bucket together again."""
    if len(parts) == 1:
        return parts[0]
    return parts[0].replace(
        **{
            name: torch.cat([getattr(part, name) for part in parts])
            for name in (
                "normals_patch",
                "albedo",
                "lights_patch",
                "valid",
                "confidence",
                "verdict",
            )
        },
        convergence=Convergence(
            iterations=torch.cat([part.convergence.iterations for part in parts]),
            residual=torch.cat([part.convergence.residual for part in parts]),
            cause=torch.cat([part.convergence.cause for part in parts]),
        ),
    )
