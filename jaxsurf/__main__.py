"""`python -m jaxsurf` is the command `jaxsurf`."""

import sys

from .cli import main

sys.exit(main())
