"""Records kept on disk under a hash of all that they depend on."""

from pimper_torch.runtime.user_cache import user_cache
from pimper_torch.store.deferred import actual, deferred
from pimper_torch.store.digest import digest, tensor_hash
from pimper_torch.store.store import Store, kept, opened, realigned

__all__ = ["Store", "actual", "deferred", "digest", "kept", "opened"]
__all__ += ["realigned", "tensor_hash", "user_cache"]
