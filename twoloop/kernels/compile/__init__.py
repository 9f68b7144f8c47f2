"""Compile callbacks and kernels and keep them on disk; all that touches private parts of numba is here."""

import re

import numba

LEAST, BELOW = (0, 61), (0, 69)  # as pyproject.toml has them


def check_version(found: str) -> None:
    """Raise unless this is a version of numba that the private parts used here are known of.

    Raises
    ------
    ImportError
        If it is not; says which is needed.
    """
    if not LEAST <= tuple(int(number) for number in re.findall(r"\d+", found)[:2]) < BELOW:
        least, below = (".".join(map(str, version)) for version in (LEAST, BELOW))
        raise ImportError(
            f"twoloop uses private parts of numba, which it knows of versions from {least} to below {below}; numba "
            f"{found} is installed: pip install 'numba>={least},<{below}'"
        )


check_version(numba.__version__)
