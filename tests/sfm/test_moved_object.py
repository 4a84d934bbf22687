from itertools import combinations

import torch

from pimper_torch.stages.sfm.moved_object import (
    correlation_clustering,
    find_moved_object,
    object_votes,
    sessions_of,
)
from tests.sfm.moved import photographed

SIZE = torch.tensor([320.0, 240.0])
SESSIONS = (0,) * 6 + (1,) * 6


def matched(sessions, num_object, num_points, same_side=2):
    """Match all features of neighbours; between sessions the table is the larger body."""
    every = torch.arange(num_points)[:, None].repeat(1, 2)
    own, table = every[:num_object], every[num_object:]
    verified, outside = {}, {}
    half = len(sessions) // 2
    for first, second in combinations(range(len(sessions)), 2):
        apart = abs(first % half - second % half)
        if min(apart, half - apart) < same_side:
            one = sessions[first] == sessions[second]
            verified[first, second] = every if one else table
            outside[first, second] = every[:0] if one else own
    return verified, outside


def found(sessions, keypoints, num_object):
    return found_in(keypoints, *matched(sessions, num_object, len(keypoints[0])))


def found_in(keypoints, verified, outside):
    return find_moved_object(
        keypoints,
        SIZE.expand(len(keypoints), 2),
        verified,
        outside,
        lambda some: some,
        max_error_px=2.0,
    )


def test_sessions_are_separated_and_linked_by_the_object_only(generator):
    keypoints, num_object = photographed(SESSIONS, generator)
    moved = found(SESSIONS, keypoints, num_object)
    assert moved.sessions.any()
    assert tuple(moved.sessions.tolist()) == SESSIONS
    pairs, _ = matched(SESSIONS, num_object, len(keypoints[0]))
    between = {pair for pair in pairs if SESSIONS[pair[0]] != SESSIONS[pair[1]]}
    assert set(moved.tying) == between
    assert all(int(rows.max()) < num_object for rows in moved.tying.values())


def test_the_object_is_the_central_body_even_with_more_features(generator):
    keypoints, num_object = photographed(SESSIONS, generator, num_object=150)
    verified, outside = matched(SESSIONS, num_object, len(keypoints[0]))
    for pair in verified:
        if SESSIONS[pair[0]] != SESSIONS[pair[1]]:  # the first geometry is that of most matches
            verified[pair], outside[pair] = outside[pair], verified[pair]
    moved = found_in(keypoints, verified, outside)
    assert tuple(moved.sessions.tolist()) == SESSIONS
    assert all(int(rows.max()) < num_object for rows in moved.tying.values())


def test_a_rigid_scene_is_one_session_despite_a_second_geometry(generator):
    keypoints, num_object = photographed((0,) * 12, generator)
    moved = found(SESSIONS, keypoints, num_object)  # matched as if there were two sessions
    assert not moved.sessions.any()
    assert not moved.tying
    assert not moved.dropped


def test_few_pairs_of_two_bodies_are_not_evidence(generator):
    keypoints, _ = photographed(SESSIONS, generator)
    assert not found(SESSIONS, keypoints, 29).sessions.any()  # fewer than required of a second body


def test_a_pair_that_shows_only_the_table_does_not_link_sessions(generator):
    keypoints, num_object = photographed(SESSIONS, generator)
    verified, outside = matched(SESSIONS, num_object, len(keypoints[0]))
    outside[0, 6] = outside[0, 6][:0]
    moved = found_in(keypoints, verified, outside)
    assert moved.dropped == ((0, 6),)
    assert (0, 6) not in moved.tying


def test_features_are_assigned_to_bodies_by_their_matches(generator):
    keypoints, num_object = photographed(SESSIONS, generator)
    verified, outside = matched(SESSIONS, num_object, len(keypoints[0]))
    seconds = {pair: outside[pair] for pair in [(0, 6), (1, 7), (2, 8)]}
    within = {pair for pair in verified if SESSIONS[pair[0]] == SESSIONS[pair[1]]}
    verified = {pair: rows for pair, rows in verified.items() if pair in within}
    verified |= {pair: matched(SESSIONS, num_object, 150)[0][pair] for pair in seconds}
    votes = object_votes(keypoints, SIZE.expand(12, 2), verified, seconds)
    assert all(bool((one[:num_object] > 0).all()) for one in votes)
    assert all(bool((one[num_object:] < 0).all()) for one in votes)
    # Views 3 to 5 and 9 to 11 have no pair of two bodies; their neighbours connect them.
    assert tuple(sessions_of(12, verified, seconds, votes).tolist()) == SESSIONS


def test_clusters_exclude_views_with_negative_affinity():
    weight = torch.zeros(5, 5, dtype=torch.float64)
    for first, second, value in [(0, 1, 9.0), (3, 4, 9.0), (1, 2, 5.0), (2, 3, 4.0), (0, 3, -20.0)]:
        weight[first, second] = weight[second, first] = value
    assert correlation_clustering(weight).tolist() == [0, 0, 0, 1, 1]
    weight[0, 2] = weight[2, 0] = -6.0
    assert correlation_clustering(weight).tolist() == [0, 0, 1, 1, 1]
