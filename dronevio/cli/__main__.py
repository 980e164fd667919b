"""``python -m dronevio.cli``, the same as ``dronevio``."""

import sys

from dronevio.cli import main

sys.exit(main())
