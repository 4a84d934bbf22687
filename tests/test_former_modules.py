import importlib
import sys

import pytest

from pimper_torch.runtime.former_modules import _FORMER, present_path

MOVED = [
    *_FORMER,
    *("doors.io", "ground.geometry", "ground.kernels.compile", "method.sfm", "published.align"),
    *("method.silhouettes.explain", "result.viz.maps", "result.viewer.show"),
]


@pytest.mark.parametrize("former", MOVED)
def test_a_former_path_is_the_present_module_and_warns(former):
    name = f"pimper_torch.{former}"
    present = importlib.import_module(f"pimper_torch.{present_path(former)}".removesuffix("."))
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


@pytest.mark.filterwarnings("ignore:.*is now:DeprecationWarning")
def test_an_unknown_module_is_still_an_error():
    with pytest.raises(ModuleNotFoundError, match=r"pimper_torch\.nothing"):
        importlib.import_module("pimper_torch.ground.nothing")
