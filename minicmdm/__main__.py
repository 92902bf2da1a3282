"""`python -m minicmdm` is the same as `minicmdm`."""

import sys

from minicmdm.cli import main

if __name__ == "__main__":
    sys.exit(main())
