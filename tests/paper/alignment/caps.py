"""A spherical cap, and changes of the height fields on its facets."""

import torch

RADIUS = 2.0
CENTER = torch.tensor([0.0, 0.0, RADIUS], dtype=torch.float64)


def cap(x, y):
    return RADIUS - (RADIUS**2 - x**2 - y**2).sqrt()


def random_transforms(count, generator):
    draw = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    tilt, scale = 0.15 * draw[:, :2], (0.35 * draw[:, 2:]).exp()
    return torch.cat([tilt, scale, torch.zeros_like(scale)], dim=1)


def changed(depths, change):
    """Replace each depth by ``change(x, y, depth, facet)``."""
    buckets = []
    for templates, height_field in zip(depths.patches.buckets, depths.buckets, strict=True):
        x, y, _ = templates.points_patch.unbind(dim=-1)
        depth = change(x, y, height_field.depth, templates.facet)
        buckets.append(height_field.replace(depth=depth))
    return depths.replace(buckets=tuple(buckets))


def spoiled(depths, transforms):
    def change(x, y, depth, facet):
        hx, hy, hz, h0 = transforms[facet][:, :, None, None].unbind(dim=1)
        return hx * x + hy * y + hz * depth + h0

    return changed(depths, change)


def waves(depths, amplitude, generator):
    """Add waves of its own, a quarter of an edge long, to every patch."""

    def change(x, y, depth, facet):
        for _ in range(6):
            fx, fy, start = torch.randn(3, len(x), 1, 1, generator=generator, dtype=torch.float64)
            wave = torch.cos(fx / 0.08 * x + fy / 0.08 * y + 9 * start)
            depth = depth + amplitude / 3**0.5 * wave
        return depth

    return changed(depths, change)


def by_facet(depths):
    """Return the transforms in the order of the facets."""
    facets = torch.cat([templates.facet for templates in depths.patches.buckets])
    transforms = torch.cat([height_field.transform for height_field in depths.buckets])
    return transforms[torch.argsort(facets)]
