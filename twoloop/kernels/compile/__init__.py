"""Compile callbacks and kernels, and cache machine code on disk. Only this package uses private parts of numba."""

import re

import numba

# oldest supported version of numba, and the first later version that is not supported, as in pyproject.toml
MIN_VERSION, END_VERSION = (0, 61), (0, 69)


def check_version(installed: str) -> None:
    """Raise an error if this version of numba is not supported; twoloop replaces private parts of numba.

    Raises ImportError if the version is not supported; the message gives the supported versions.
    """
    if not MIN_VERSION <= tuple(int(number) for number in re.findall(r"\d+", installed)[:2]) < END_VERSION:
        least, below = (".".join(map(str, version)) for version in (MIN_VERSION, END_VERSION))
        raise ImportError(
            f"twoloop uses private parts of numba, and supports versions from {least} to below {below}; numba "
            f"{installed} is installed: pip install 'numba>={least},<{below}'"
        )


check_version(numba.__version__)
