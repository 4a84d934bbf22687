import torch

from pimper_torch.stages.sfm.retrieval import global_descriptors, nearest_pairs, vocabulary


def walk(count, generator, seen=40):
    """Return descriptors of photographs once around a wall; neighbours share most points."""
    wall = torch.nn.functional.normalize(torch.rand(5 * count, 128, generator=generator), dim=1)
    each = []
    for number in range(count):
        points = (5 * number + torch.arange(seen)) % len(wall)
        noise = 0.01 * torch.rand(seen, 128, generator=generator)
        each.append(torch.nn.functional.normalize(wall[points] + noise, dim=1))
    return each


def test_neighbours_are_retrieved_and_pairs_grow_with_photographs(generator):
    counts = []
    for count in (100, 200):
        pairs = nearest_pairs(global_descriptors(walk(count, generator).__getitem__, count), 6)
        steps = [min(second - first, first + count - second) for first, second in pairs]
        assert sum(step <= 7 for step in steps) >= 0.95 * len(steps)  # 7 steps share 5 of 40
        assert sum(step == 1 for step in steps) == count  # all are neighbours
        counts.append(len(pairs))
        assert len(pairs) <= 6 * count
    assert counts[1] <= 2.2 * counts[0]


def test_global_descriptors_are_reproducible_and_zero_without_features(generator):
    some = walk(70, generator)
    some[3] = some[3][:0]
    first, second = (global_descriptors(some.__getitem__, 70) for _ in range(2))
    assert torch.equal(first, second)
    assert torch.equal(first[3], torch.zeros_like(first[3]))
    lengths = first[[index for index in range(70) if index != 3]].norm(dim=1)
    assert (lengths - 1).abs().max() < 1e-5  # rounding of 16,384 squares in float32


def test_every_pair_of_few_photographs_is_listed_once():
    assert nearest_pairs(torch.eye(4), 20) == [(a, b) for a in range(4) for b in range(a + 1, 4)]


def test_words_are_the_centres_of_clusters(generator):
    centres = 10 * torch.eye(4, 128)
    some = (centres[:, None] + torch.randn(4, 50, 128, generator=generator)).flatten(0, 1)
    found = vocabulary(some, 4)
    means = some.reshape(4, 50, 128).mean(dim=1)
    assert torch.cdist(found, means).amin(dim=1).max() < 1e-4  # of float32 sums
