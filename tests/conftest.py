"""For all tests: one BLAS thread, as the pipeline's child processes have; many fight over few cores."""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read when NumPy is first imported
