"""Conventions of guessed maps, found by the scene, and guesses of networks."""

from pimper_torch.priors.network import priors_of as priors_of
from pimper_torch.priors.settled import settled as settled
