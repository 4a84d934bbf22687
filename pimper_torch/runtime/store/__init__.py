"""Records kept on disk under a hash of all that they depend on."""

from pimper_torch.runtime.store.digest import digest
from pimper_torch.runtime.store.store import Store, kept, opened, settled

__all__ = ["Store", "digest", "kept", "opened", "settled"]
