import importlib
import sys

import pytest

from pimper_torch.runtime.former_modules import _FORMER


@pytest.mark.parametrize("former", [path for path, present in _FORMER.items() if present])
def test_a_former_path_is_the_present_module_and_warns(former):
    name = f"pimper_torch.{former}"
    present = importlib.import_module(f"pimper_torch.{_FORMER[former]}")
    spec = present.__spec__
    sys.modules.pop(name, None)
    with pytest.warns(DeprecationWarning, match=f"`{name}` is now `{present.__name__}`"):
        found = importlib.import_module(name)
    assert found is present
    assert present.__spec__ is spec


def test_a_module_in_a_moved_folder_has_no_second_copy():
    sys.modules.pop("pimper_torch.ground.geometry", None)
    with pytest.warns(DeprecationWarning, match=r"is now `pimper_torch\.geometry`"):
        from pimper_torch.ground.geometry import rigid as former
    from pimper_torch.geometry import rigid

    assert former is rigid


def test_an_unknown_module_is_still_an_error():
    with pytest.raises(ModuleNotFoundError, match=r"pimper_torch\.ground\.nothing"):
        importlib.import_module("pimper_torch.ground.nothing")
