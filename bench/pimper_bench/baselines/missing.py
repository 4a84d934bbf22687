"""The error of a baseline whose program is not there."""

from pimper_torch.runtime.errors import ReconstructionError


class MissingProgramError(ReconstructionError):
    """A program that somebody else wrote is not installed here."""
