"""A cache of machine code for the processes of a test, with the kernels in it: they would compile for half a minute."""

import shutil
from pathlib import Path

from numba.core.caching import _CacheLocator

from twoloop.kernels.evaluation import calls


def with_kernels(cache):
    """Fill a folder for NUMBA_CACHE_DIR with the inner loop, which every run needs, as this process has it."""
    folder = cache / _CacheLocator.get_suitable_cache_subpath(calls.__file__)
    folder.mkdir(parents=True)
    for file in Path(calls.inner_loop._cache.cache_path).glob("calls.inner_loop-*"):
        shutil.copy(file, folder)
    return cache
