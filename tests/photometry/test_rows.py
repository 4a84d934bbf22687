"""Rows of samples against the rasters they come from."""

import torch
from torch.testing import assert_close

from pimper_torch.photometry.rows import on_raster, rows_of


def test_rows_hold_the_samples_inside_and_go_back_where_they_were(scene):
    seen = scene().seen
    templates, observed = seen.patches.buckets[0], seen.buckets[0]
    radiance, valid = observed.radiance.clone(), observed.valid.clone()
    radiance[1, 2, 0, 5, 6] = torch.nan
    valid[1, 2, 5, 6] = True
    normals = torch.rand(*templates.depth.shape, 3, dtype=torch.float64)
    rows = rows_of(templates, observed.replace(radiance=radiance, valid=valid), normals)
    assert rows.index.shape[1] == int(templates.inside.sum(dim=(1, 2)).max())
    for patch, inside in enumerate(templates.inside):
        count = int(inside.sum())
        own = rows.index[patch, :count]
        assert_close(own, inside.flatten().nonzero()[:, 0])
        expected = radiance[patch][..., inside].nan_to_num(0)
        shown = valid[patch][:, inside] & radiance[patch][..., inside].isfinite().all(dim=1)
        assert (rows.seen[patch, :, :count] == shown).all()
        assert_close(rows.radiance[patch, ..., :count], expected * shown[:, None])
        assert not rows.seen[patch, :, count:].any()
        assert_close(rows.normals[patch, :count], normals[patch][inside])
    assert not rows.seen[1, 2][rows.index[1] == 5 * templates.depth.shape[2] + 6].any()  # NaN
    background = torch.full_like(normals, 7.0)
    back = on_raster(rows.normals, rows.index, background)
    assert_close(back[templates.inside], normals[templates.inside])
    depth = on_raster(rows.normals[..., 0], rows.index, background[..., 0])
    assert_close(depth, back[..., 0])
    far = templates.inside.sum(dim=(1, 2)) == rows.index.shape[1]  # without padding
    assert far.any()
    assert (back[far][~templates.inside[far]] == 7).all()
