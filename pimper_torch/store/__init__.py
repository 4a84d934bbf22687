"""Records kept on disk under a hash of all that they depend on."""

from pimper_torch.store.digest import digest
from pimper_torch.store.settled import settled
from pimper_torch.store.store import Kept, Store, opened

__all__ = ["Kept", "Store", "digest", "opened", "settled"]
