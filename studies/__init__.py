"""The bench and the studies, whose runs become the reports. Each runs on one thread, whoever starts it."""

import os

# before numpy and JAX are imported, or they would not see it: times of one thread can be compared, and no BLAS changes
# a count
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"):
    os.environ[_name] = "1"
_ONE = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
if _ONE not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_ONE}".strip()
