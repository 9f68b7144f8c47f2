"""A cache of machine code for the processes of a test, with the kernels in it: they would compile for half a minute."""

import shutil
from pathlib import Path

from numba.core.caching import _CacheLocator

from twoloop.kernels import lanes
from twoloop.kernels.evaluation import calls

IMPORTED = {lanes: lanes.advance_lanes, calls: calls.inner_loop}  # with twoloop, and compiled at once


def with_kernels(cache):
    """Fill a folder for NUMBA_CACHE_DIR with what this process has read or compiled."""
    for module, kernel in IMPORTED.items():
        folder = cache / _CacheLocator.get_suitable_cache_subpath(module.__file__)
        folder.mkdir(parents=True)
        for file in Path(kernel._cache.cache_path).glob(f"{module.__name__.rpartition('.')[2]}.{kernel.__name__}-*"):
            shutil.copy(file, folder)
    return cache
