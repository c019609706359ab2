"""The cell: cell file, sequence, gates, store, daemon, console and report."""

import os

# The matrices here are small: threads of the linear algebra cost more than they bring, many times more on a
# busy computer. Read when numpy is first imported, so it stands here.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
