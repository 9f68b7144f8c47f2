"""Compile callbacks and kernels and cache them on disk; all uses of private parts of numba are here."""

import re

import numba

LEAST, BELOW = (0, 61), (0, 69)  # supported versions of numba: from LEAST to below BELOW, as in pyproject.toml


def check_version(installed: str) -> None:
    """Raise unless this version of numba is supported, because twoloop replaces private parts of numba.

    Raises
    ------
    ImportError
        If the version is not supported; the message names those that are.
    """
    if not LEAST <= tuple(int(number) for number in re.findall(r"\d+", installed)[:2]) < BELOW:
        least, below = (".".join(map(str, version)) for version in (LEAST, BELOW))
        raise ImportError(
            f"twoloop uses private parts of numba, which it knows of versions from {least} to below {below}; numba "
            f"{installed} is installed: pip install 'numba>={least},<{below}'"
        )


check_version(numba.__version__)
