from pimper_torch.stages.sfm.matching import all_pairs, strongest, tiles


def test_tiles_contain_every_pair_once_and_few_photographs_each():
    pairs = all_pairs(60)
    groups = list(tiles(pairs))
    assert sorted(pair for some in groups for pair in some) == sorted(pairs)
    assert len(pairs) == 60 * 59 // 2
    assert max(len({view for pair in some for view in pair}) for some in groups) <= 32


def test_tiles_of_sparse_pairs_are_well_filled():
    pairs = [pair for pair in all_pairs(300) if pair[1] - pair[0] <= 10]
    groups = list(tiles(pairs))
    assert sorted(pair for some in groups for pair in some) == pairs
    prepared = sum(len({view for pair in some for view in pair}) for some in groups)
    assert prepared <= 3 * 300


def test_the_strongest_pairs_of_every_photograph_are_listed_once():
    counts = {(0, 1): 50, (0, 2): 40, (0, 3): 30, (1, 2): 20, (1, 3): 60, (2, 3): 10}
    assert strongest(counts, 4, 1) == [(0, 1), (0, 2), (1, 3)]
    assert strongest(counts, 4, 10) == sorted(counts)
    assert strongest(counts, 4, 0) == []
