"""Many objects: whole reconstructions over any ``concurrent.futures.Executor``."""

from pimper_torch.batches.many_objects import batch as batch
from pimper_torch.batches.objects import Object as Object
from pimper_torch.batches.task import Outcome as Outcome
