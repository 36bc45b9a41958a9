"""Tests, one room for each room of the package."""

import os

# Before numpy is imported. Test processes run side by side on all cores: threads of BLAS would
# fight for them, and take three times as long. Processes that tests start inherit it.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
