import torch
from scipy.ndimage import map_coordinates
from torch.testing import assert_close

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.stages.coarse.window_matching import RADIUS, Matcher, MatchingLevel, pair

OFFSETS = [-0.2, -0.003, 0.0, 0.004, 0.05]


def textured(width=61, height=47, dtype=torch.float32):
    """Return five views of noise, each with invalid pixels, also at the borders."""
    generator = torch.Generator().manual_seed(0)
    tone = 0.2 + torch.rand(5, height, width, generator=generator, dtype=torch.float64)
    usable = torch.rand(5, height, width, generator=generator) > 0.1
    usable[:, 5:9, 10:30] = False
    usable[2, 20] = False
    cameras = arc_cameras(
        5, width=width, height=height, focal_px=90.0, distance=4.0, sway_deg=0.0
    ).to(dtype)
    return MatchingLevel(tone=tone.to(dtype), usable=usable, cameras=cameras)


def field(level):
    height, width = level.tone.shape[-2:]
    rows = torch.linspace(0.2, 0.3, height, dtype=level.tone.dtype)
    return rows[:, None] + 0.02 * torch.sin(torch.arange(width).to(rows))


def correlations(level, sources, inverse_depth):
    """Compute the scores of one depth field in double precision by definition."""
    height, width = level.tone.shape[-2:]
    rows = torch.arange(height)[:, None] + torch.zeros(width, dtype=torch.long)
    columns = torch.zeros(height, dtype=torch.long)[:, None] + torch.arange(width)
    steps = range(-RADIUS, RADIUS + 1)
    places = [
        ((rows + down).clamp(0, height - 1), (columns + right).clamp(0, width - 1))
        for down in steps
        for right in steps
    ]
    away = torch.tensor([[down, right] for down in steps for right in steps]).double()
    tone, usable = level.tone[2].double(), level.usable[2].double()
    around = torch.stack([tone[place] for place in places])
    weight = torch.exp(-away.square().sum(dim=1) / RADIUS**2 / 2)[:, None, None]
    weight = weight * torch.exp(-((around - tone) / 0.2).square() / 2)
    weight = weight * torch.stack([usable[place] for place in places])
    weight = weight / weight.sum(dim=0).clamp_min(1e-12)
    around = around - (weight * around).sum(dim=0)
    pixels, ratio = pair(level, 2, sources).project(inverse_depth)
    scores = []
    for index, source in enumerate(sources.tolist()):
        u, v = (pixels[index] - 0.5).double()
        u_in, v_in = u.clamp(0, width - 1), v.clamp(0, height - 1)
        seen = map_coordinates(level.tone[source].double().numpy(), [v_in, u_in], order=1)
        seen = torch.stack([torch.from_numpy(seen)[place] for place in places])
        seen = seen - (weight * seen).sum(dim=0)
        powers = [(weight * one.square()).sum(dim=0) + 0.005**2 for one in (seen, around)]
        score = (weight * seen * around).sum(dim=0) / (powers[0] * powers[1]).sqrt()
        inside = ((u - u_in).abs() <= 0.5) & ((v - v_in).abs() <= 0.5) & (ratio[index] > 0)
        nearest = level.usable[source][v_in.round().long(), u_in.round().long()]
        scores.append(torch.where(inside & nearest & level.usable[2], score, 0))
    return torch.stack(scores).topk(min(3, len(scores)), dim=0).values.mean(dim=0)


def expected_scores(level, sources):
    smallest = torch.finfo(torch.float32).tiny
    moved = [(field(level) + one).clamp_min(smallest) for one in OFFSETS]
    return torch.stack([correlations(level, sources, one) for one in moved])


def test_scores_are_mean_correlations_of_the_best_sources():
    level, sources = textured(), torch.tensor([0, 1, 3, 4])
    found = Matcher(level, pair(level, 2, sources)).scores(field(level), OFFSETS)
    expected = expected_scores(level, sources).float()
    assert not bool(found[:, ~level.usable[2]].any())
    assert float((expected != 0).double().mean()) > 0.5
    # Positions within rounding of a border between pixels may round to either.
    off = (found - expected).abs()
    assert float((off > 1e-4).double().mean()) < 1e-3
    assert_close(found[off <= 1e-4], expected[off <= 1e-4], atol=1e-4, rtol=0)


def test_windows_of_narrow_and_empty_images_are_scored():
    level = textured(width=3, height=300)
    sources = torch.tensor([1, 3])
    found = Matcher(level, pair(level, 2, sources)).scores(field(level), OFFSETS)
    off = (found - expected_scores(level, sources)).abs()
    assert float((off > 1e-4).double().mean()) < 1e-2
    dark = level.replace(usable=torch.zeros_like(level.usable))
    none = Matcher(dark, pair(dark, 2, sources)).scores(field(dark), OFFSETS)
    assert_close(none, torch.zeros_like(none))


def test_scores_have_the_dtype_of_differentiable_float64_input():
    level, sources = textured(), torch.tensor([1, 3])
    single = Matcher(level, pair(level, 2, sources)).scores(field(level), OFFSETS)
    double = textured(dtype=torch.float64)
    double = double.replace(tone=double.tone.requires_grad_())
    found = Matcher(double, pair(double, 2, sources)).scores(field(double), OFFSETS)
    assert found.dtype == torch.float64
    assert not found.requires_grad
    assert float(((found - single).abs() > 1e-4).double().mean()) < 1e-3
