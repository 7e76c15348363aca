"""``python -m sb3_quad.cli``."""

import sys

from sb3_quad.cli import main

if __name__ == "__main__":  # worker processes import this module too
    sys.exit(main())
