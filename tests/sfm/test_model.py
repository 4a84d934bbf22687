import torch

from pimper_torch.records.sparse_model import drop_weak_views, longest_tracks, select_views


def test_a_point_seen_by_only_one_kept_view_is_removed(model):
    kept = select_views(model, [3, 1])
    assert kept.names == ("d.jpg", "a.jpg")
    seen = torch.zeros(40, 5, dtype=torch.bool)
    seen[model.observation_point, model.observation_view] = True
    both = seen[:, 3] & seen[:, 1]
    assert 0 < both.sum() < 40
    assert torch.equal(kept.points_world, model.points_world[both])
    assert len(kept.observation_point) == 2 * both.sum()
    # Observations still belong to their views and points.
    for point, view, pixel in zip(
        kept.observation_point, kept.observation_view, kept.observation_pixels, strict=True
    ):
        old_point, old_view = torch.nonzero(both)[point, 0], (3, 1)[view]
        old = (model.observation_point == old_point) & (model.observation_view == old_view)
        assert torch.equal(model.observation_pixels[old][0], pixel)


def test_maps_to_a_static_background_follow_their_views(model):
    maps = torch.arange(45.0, dtype=torch.float64).reshape(5, 3, 3)
    kept = select_views(model.replace(background_from_view=maps), [3, 1])
    assert torch.equal(kept.background_from_view, maps[[3, 1]])
    assert len(select_views(model, [3, 1]).background_from_view) == 0


def test_a_view_that_loses_its_points_with_a_weak_view_is_removed(model):
    # View 2 shares 20 points with the others; view 3 has 12 points, 8 of them shared only with
    # view 4, which sees just these 8. After the removal of view 4, view 3 keeps 4 points.
    pairs = [(p, v) for p in range(20) for v in (0, 1, 2)]
    pairs += [(p, 3) for p in range(4)] + [(p, v) for p in range(20, 28) for v in (3, 4)]
    point, view = torch.tensor(pairs).T
    tangled = model.replace(
        observation_point=point, observation_view=view, observation_pixels=torch.zeros(80, 2)
    )
    left = drop_weak_views(tangled, 10)
    assert left.names == model.names[:3]
    assert len(left.points_world) == 20
    assert drop_weak_views(left, 20).names == left.names
    assert drop_weak_views(left, 21).num_views == 0


def test_every_view_keeps_the_points_that_most_views_see(model):
    seen = model.observed
    length = seen.sum(dim=1)
    wanted = torch.zeros(40, dtype=torch.bool)
    for view in range(5):
        (mine,) = torch.nonzero(seen[:, view], as_tuple=True)
        wanted[mine[torch.argsort(length[mine], descending=True, stable=True)][:3]] = True
    wanted &= length >= 2
    assert 3 <= wanted.sum() < 16
    kept = longest_tracks(model, 3)
    assert torch.equal(kept.points_world, model.points_world[wanted])
    assert torch.equal(kept.observed, seen[wanted])
    assert len(longest_tracks(model, 40).points_world) == int((length >= 2).sum())
