"""Records kept on disk under a hash of all that they depend on."""

from pimper_torch.runtime.store.digest import digest
from pimper_torch.runtime.store.store import Store, kept, opened, realigned
from pimper_torch.runtime.user_cache import user_cache

__all__ = ["Store", "digest", "kept", "opened", "realigned", "user_cache"]
