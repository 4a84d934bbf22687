import torch

from pimper_torch.stages.coarse.reference import reference_view


def test_the_frontal_view_is_the_centre_of_the_arc(dome_cloud):
    assert reference_view(dome_cloud) == 2


def test_many_neighbours_outweigh_one_close_view(dome_cloud):
    # Views 0 and 1 share 60 points; view 2 shares 20 with each of three others.
    pairs = {(0, 1): 60, (2, 3): 20, (2, 4): 20, (2, 0): 20}
    ends = [(view, pair) for pair, count in pairs.items() for _ in range(count) for view in pair]
    point = torch.arange(120).repeat_interleave(2)
    scene = dome_cloud.replace(
        points_world=dome_cloud.points_world[:120],
        reprojection_errors_px=dome_cloud.reprojection_errors_px[:120],
        observation_point=point,
        observation_view=torch.tensor([view for view, _ in ends]),
        observation_pixels=dome_cloud.observation_pixels[: len(point)],
    )
    shared = (scene.observed.long().mT @ scene.observed.long()).fill_diagonal_(0)
    assert shared.sum(dim=1).argmax() == 0
    assert reference_view(scene) == 2


def test_a_view_is_found_by_file_name_and_by_stem(dome_cloud):
    name = dome_cloud.views.names[3]
    assert reference_view(dome_cloud, name) == 3
    assert reference_view(dome_cloud, name.rsplit(".", 1)[0]) == 3
