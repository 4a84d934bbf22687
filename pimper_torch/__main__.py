"""``python -m pimper_torch`` is ``pimper``."""

import sys

from pimper_torch.cli.supervise import main

if __name__ == "__main__":  # not where a process of a pool is started
    sys.exit(main())
