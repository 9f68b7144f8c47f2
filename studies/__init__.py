"""The bench and the studies, whose runs become the reports. Each runs on one thread, whoever starts it."""

import os

# before numpy and JAX are imported, or they would not see it: times of one thread can be compared, and no BLAS changes
# a count; NPROC is the size of XLA's pool, which its flags leave at one thread a core; no core is taken away, for
# sweeps use each with a process of its own
_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS", "NPROC")
for _name in _THREADS:
    os.environ[_name] = "1"
_ONE = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
if _ONE not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_ONE}".strip()
