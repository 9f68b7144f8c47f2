"""Compile callbacks and kernels, and cache machine code on disk. Only this package uses private parts of numba."""

import re

import numba

# versions of numba from the first to below the second are supported, as in pyproject.toml
MIN_VERSION, END_VERSION = (0, 61), (0, 69)


def check_version(installed: str) -> None:
    """Raise ImportError if this version of numba is not supported; its private parts change from version to version."""
    if not MIN_VERSION <= tuple(int(number) for number in re.findall(r"\d+", installed)[:2]) < END_VERSION:
        least, below = (".".join(map(str, version)) for version in (MIN_VERSION, END_VERSION))
        raise ImportError(
            f"twoloop uses private parts of numba, and supports versions from {least} to below {below}; numba "
            f"{installed} is installed: pip install 'numba>={least},<{below}'"
        )


check_version(numba.__version__)
