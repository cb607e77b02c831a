"""`python -m experiments`: see `harness.py`."""

import sys

from experiments.harness import main

sys.exit(main())
