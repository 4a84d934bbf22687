"""Batches: reconstructions of many objects by any ``concurrent.futures.Executor``."""

from pimper_torch.cli.batches.many_objects import batch as batch
from pimper_torch.cli.batches.objects import Object as Object
from pimper_torch.cli.batches.task import Outcome as Outcome
