import pytest
import torch
from scenes import each_bucket
from torch.testing import assert_close

from pimper_torch.records import SweptPatches
from pimper_torch.stages.patches.warp import Warp
from pimper_torch.stages.sweep.sweep import Sweep
from pimper_torch.stages.sweep.sweep_config import SweepConfig


def sweep(lifted, config: SweepConfig | None = None) -> SweptPatches:
    scene = lifted.scene
    return Sweep(config)(scene.views, scene.cameras, lifted.seen, lifted.photometric)


def determined(swept: SweptPatches) -> tuple[torch.Tensor, torch.Tensor]:
    """Return determined offsets and their standard deviations, in samples."""
    offsets, deviations = [], []
    for templates, found in zip(swept.patches.buckets, swept.buckets, strict=True):
        known = found.information > 0
        spacing = templates.spacing[:, None, None].expand_as(known)[known]
        offsets.append(found.offset[known] / spacing)
        deviations.append(found.information[known].rsqrt() / spacing)
    return torch.cat(offsets), torch.cat(deviations)


@pytest.mark.parametrize("height", [-1.7, 0.0, 1.2])
def test_the_sweep_recovers_the_offset_of_facets(lift, height):
    lifted = lift(height)
    offsets, _ = determined(sweep(lifted))
    inside = sum(int(bucket.inside.sum()) for bucket in lifted.seen.patches.buckets)
    assert len(offsets) > 0.8 * inside
    off = (offsets + lifted.height).abs()
    assert off.median() < 0.05  # a fourteenth of a step
    assert off.quantile(0.9) < 0.2


def test_offsets_beyond_the_range_are_not_reported(lift):
    lifted = lift(6.0)
    offsets, _ = determined(sweep(lifted, SweepConfig(steps=2)))
    inside = sum(int(bucket.inside.sum()) for bucket in lifted.seen.patches.buckets)
    assert len(offsets) < 0.5 * inside


def test_without_texture_the_sweep_has_little_information(lift):
    bare, textured = (determined(sweep(lift(0.5, textured=each))) for each in (False, True))
    # All heights are equally consistent: a plane's shading does not depend on height.
    total = [float((1 / deviation.square()).sum()) for _, deviation in (bare, textured)]
    assert total[0] < 0.01 * total[1]


def test_wrong_lights_bias_heights_by_less_than_a_step(lift):
    lifted = lift(1.2)
    gain = torch.where(torch.arange(9) % 4 == 0, 1.6, 1.0)[:, None]  # three of nine are wrong
    wrong = each_bucket(
        lifted.photometric, lambda found: found.replace(lights_patch=gain * found.lights_patch)
    )
    scene = lifted.scene
    offsets, _ = determined(Sweep()(scene.views, scene.cameras, lifted.seen, wrong))
    assert (offsets + lifted.height).abs().median() < 0.3


def test_samples_without_photometric_normals_are_swept_alike(lift):
    lifted = lift(1.2)
    dark = each_bucket(
        lifted.photometric,
        lambda found: found.replace(valid=found.valid & False, information=0 * found.information),
    )
    scene = lifted.scene
    swept = Sweep()(scene.views, scene.cameras, lifted.seen, dark)
    for mine, lit in zip(swept.buckets, sweep(lifted).buckets, strict=True):
        assert_close(mine.offset, lit.offset, rtol=0, atol=0)
        assert_close(mine.information, lit.information, rtol=0, atol=0)
    black = each_bucket(dark, lambda found: found.replace(albedo=0 * found.albedo))
    unseen = Sweep()(scene.views, scene.cameras, lifted.seen, black)
    assert all((bucket.information == 0).all() for bucket in unseen.buckets)


def test_fewer_views_suffice_down_to_min_views(lift):
    lifted = lift(-1.0)
    offsets, _ = determined(sweep(lifted, SweepConfig(num_views=5)))
    assert (offsets + lifted.height).abs().median() < 0.1
    none = sweep(lifted, SweepConfig(min_views=10, num_views=10))
    assert all((bucket.information == 0).all() for bucket in none.buckets)
    assert all((bucket.offset == 0).all() for bucket in none.buckets)


@pytest.mark.parametrize("height", [0.4, -1.1])
@pytest.mark.parametrize("noise", [0.005, 0.01, 0.02, 0.04])
def test_the_stated_deviation_is_that_of_the_error(lift, noise, height):
    lifted = lift(height)
    views, cameras, fitted = lifted.scene.views, lifted.scene.cameras, lifted.photometric
    drawn = torch.randn(views.images.shape, generator=torch.Generator().manual_seed(0))
    noisy = views.replace(images=views.images + noise * drawn)
    seen = Warp()(noisy, cameras, fitted.patches)
    buckets = []
    for rough, smooth, found in zip(seen.buckets, lifted.seen.buckets, fitted.buckets, strict=True):
        # The residual that a factorization of these photographs would have.
        spread = (rough.gray - smooth.gray)[rough.valid & smooth.valid].std()
        ended = found.convergence
        ended = ended.replace(residual=torch.full_like(ended.residual, float(spread)))
        buckets.append(found.replace(convergence=ended))
    swept = Sweep()(noisy, cameras, seen, fitted.replace(buckets=tuple(buckets)))
    offsets, deviations = determined(swept)
    error = (offsets + lifted.height) / (deviations / swept.averaged**0.5)
    # 0.6745: the median of a standard normal's absolute values. Measured 0.82 to 1.21: the
    # number of samples that share pixels, and thus noise, varies with the view.
    assert 0.8 < float(error.abs().median()) / 0.6745 < 1.25


def copied(lifted, copies):
    """Return repeated photographs, with poses that identify the repetitions."""
    scene = lifted.scene
    views = scene.views.take(copies)
    views = views.replace(names=tuple(map(str, range(len(copies)))), poses=torch.tensor(copies))

    def again(bucket, *names):
        return bucket.replace(**{name: getattr(bucket, name)[:, copies] for name in names})

    seen = each_bucket(lifted.seen, lambda one: again(one, "radiance", "valid", "viewers"))
    photometric = each_bucket(lifted.photometric, lambda one: again(one, "lights_patch"))
    return views, scene.cameras.take(copies), seen, photometric


@pytest.mark.parametrize("kind", [torch.float32, torch.float64])  # compiled and torch
def test_photographs_of_one_pose_are_compared_over_poses_first(lift, kind):
    lifted = lift(0.4)
    five = [record.to(kind) for record in copied(lifted, [0, 2, 4, 6, 8])]
    many = [record.to(kind) for record in copied(lifted, [0, 2, 2, 2, 2, 4, 4, 6, 8, 8, 8, 8])]
    config = SweepConfig(num_views=5)
    alone, again = (determined(Sweep(config)(*records))[0] for records in (five, many))
    assert_close(alone, again)
    unknown = many[0].replace(poses=None), *many[1:]
    assert len(determined(Sweep(config)(*unknown))[0]) != len(alone)
    two = [record.to(kind) for record in copied(lifted, [0, 0, 0, 8, 8, 8])]
    assert len(determined(Sweep(config)(*two))[0]) == 0  # three poses are needed
