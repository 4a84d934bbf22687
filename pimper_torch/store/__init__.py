"""Records kept on disk under a hash of all that they depend on."""

from pimper_torch.runtime.user_cache import user_cache
from pimper_torch.store.digest import digest
from pimper_torch.store.store import Store, kept, opened, realigned

__all__ = ["Store", "digest", "kept", "opened", "realigned", "user_cache"]
