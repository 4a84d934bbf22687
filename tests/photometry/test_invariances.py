"""Normals are invariant to the order of views and patches and to brightness."""

import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from solved import solved
from torch.testing import assert_close

from pimper_torch.records import PatchViews
from pimper_torch.stages.photometry.factorize import Factorize

SEEDS = st.integers(0, 2**31 - 1)


def shuffled(count, seed):
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))


@settings(
    max_examples=5,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(seed=SEEDS, power=st.integers(-10, 10))
def test_order_and_brightness_do_not_change_normals(scene, seed, power):
    seen = scene().seen
    usual = solved(Factorize(), seen)
    gain, views = 2.0**power, shuffled(12, seed)
    orders = [
        shuffled(len(one.radiance), seed + 1 + index) for index, one in enumerate(seen.buckets)
    ]
    patches = seen.patches.replace(
        buckets=tuple(
            one.take(order) for one, order in zip(seen.patches.buckets, orders, strict=True)
        )
    )
    buckets = tuple(
        one.replace(radiance=gain * one.radiance[:, views], valid=one.valid[:, views]).take(order)
        for one, order in zip(seen.buckets, orders, strict=True)
    )
    found = solved(Factorize(), PatchViews(patches=patches, buckets=buckets))
    for before, after, order in zip(usual.buckets, found.buckets, orders, strict=True):
        assert torch.equal(after.valid, before.valid[order])
        normals = before.normals_patch[order]
        away = (after.normals_patch - normals).norm(dim=-1)[after.valid]
        assert away.median() < 1e-4
        assert away.quantile(0.99) < 0.02
        # Radiance is albedo times light: their product takes the gain.
        shading, usual_shading = (
            one.albedo.mean() * one.lights_patch[..., 0].mean() for one in (after, before)
        )
        assert_close(shading, gain * usual_shading, rtol=1e-3, atol=0)
        assert torch.equal(after.status, before.status[order])
