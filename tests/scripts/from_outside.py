"""Use the installed package like a program outside the repository; types are checked as well."""

import sys
from pathlib import Path
from typing import assert_type

import pimper_torch as pt
from pimper_torch.cli.options import bundled_photographs
from pimper_torch.runtime.config import presets


def main(site_packages: str) -> None:
    """Refuse another installation of the package, or one without its data."""
    home = Path(str(pt.__file__)).parent
    assert home == Path(site_packages) / "pimper_torch", home
    assert {"default", "fast", "paper"} <= set(presets())
    assert len(list(bundled_photographs().glob("*.jpg"))) == 26
    assert (bundled_photographs() / "ATTRIBUTION.md").is_file()
    assert (home / "py.typed").is_file()
    chain = pt.load_chain("default")
    assert_type(chain, pt.CoarseToFine)


def reconstructed(folder: str) -> pt.Mesh:
    """Return values whose types a type checker must know; never called."""
    return assert_type(pt.load_chain("default")(pt.load_views(folder)), pt.Reconstruction).mesh


if __name__ == "__main__":
    main(sys.argv[1])
