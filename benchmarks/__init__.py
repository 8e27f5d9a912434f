"""Benchmarks: accuracy, failures and time of every method that users would compare.

Linear algebra stays on one thread, which has to be said before NumPy is loaded: threads that wait
for work count as CPU time.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
