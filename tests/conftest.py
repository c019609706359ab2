"""For every test: one thread of linear algebra each, as in the daemon."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
