"""Pairs of photographs that are likely to match, from one global descriptor per photograph.

All pairs of a thousand photographs are half a million, of which some ten thousand matter. A vector
of locally aggregated descriptors (VLAD) sums, for each word of a small vocabulary, the differences
of a photograph's features from the word; photographs of the same surface have similar vectors. The
vocabulary is learned from the photographs themselves, so nothing is downloaded.

Source: Jégou, Douze, Schmid & Pérez, Aggregating local descriptors into a compact image
representation, CVPR 2010; the square root of Jégou & Chum, Negative evidences and co-occurences in
image retrieval, ECCV 2012.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.geometry.colmap_library import loaded, quiet
from pimper_torch.runtime.parallel import on_one_thread
from pimper_torch.stages.sfm.features import Workspace, image_ids
from pimper_torch.stages.sfm.matching import MOST_PAIRED, PhotographPair, all_pairs, read_features

# Words of the vocabulary, and neighbours per photograph: see docs/decisions.md.
_WORDS, _NEIGHBOURS = 128, 20

Descriptors = Float[Tensor, "feature length"]


def pairs_to_match(space: Workspace) -> list[PhotographPair]:
    """List all pairs of a small set; for a large one, each photograph with the most similar."""
    if len(space.files) <= MOST_PAIRED:
        return all_pairs(len(space.files))
    with quiet(), loaded().Database.open(space.database) as database, on_one_thread():
        image_of = image_ids(database, space)

        def descriptors(number: int) -> Descriptors:
            return read_features(database, image_of[number]).descriptors

        return nearest_pairs(global_descriptors(descriptors, len(space.files)), _NEIGHBOURS)


def global_descriptors(
    descriptors: Callable[[int], Descriptors], count: int
) -> Float[Tensor, "photograph word_length"]:
    """Return a unit vector for each photograph; 0 for one without features."""
    most = -(-40_000 // count)
    learned = torch.cat([_some(descriptors(number), most) for number in range(count)])
    words = vocabulary(learned, _WORDS)
    vectors = []
    for number in range(count):
        features = descriptors(number)
        word = _nearest(features, words)
        sums = torch.zeros_like(words).index_add(0, word, features - words[word]).flatten()
        vectors.append(normalize(sums.sign() * sums.abs().sqrt(), dim=0))
    return torch.stack(vectors)


def vocabulary(descriptors: Descriptors, count: int) -> Float[Tensor, "word length"]:
    """Return cluster centres (k-means), initialized evenly among the descriptors."""
    words = _some(descriptors, count)
    for _ in range(10):
        word = _nearest(descriptors, words)
        sums = torch.zeros_like(words).index_add(0, word, descriptors)
        sizes = torch.bincount(word, minlength=len(words))[:, None]
        words = torch.where(sizes > 0, sums / sizes.clamp_min(1), words)
    return words


def nearest_pairs(
    vectors: Float[Tensor, "photograph length"], neighbours: int
) -> list[PhotographPair]:
    """List, without repetition, the pairs of each vector with the most similar ones."""
    pairs: set[PhotographPair] = set()
    for number, vector in enumerate(vectors):
        likeness = vectors @ vector
        likeness[number] = -torch.inf
        for other in likeness.topk(min(neighbours, len(vectors) - 1)).indices.tolist():
            pairs.add((min(number, other), max(number, other)))
    return sorted(pairs)


def _some(descriptors: Descriptors, most: int) -> Descriptors:
    """Return at most ``most`` descriptors, evenly sampled."""
    return descriptors[:: max(1, -(-len(descriptors) // most))]


def _nearest(descriptors: Descriptors, words: Float[Tensor, "word length"]) -> Tensor:
    return (descriptors @ words.mT - words.square().sum(dim=1) / 2).argmax(dim=1)
