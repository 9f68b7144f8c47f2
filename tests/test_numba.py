"""Private parts of numba: in one folder, of versions that are known, and put back after each compilation."""

import re
import tomllib
from pathlib import Path

import pytest
from numba.core.types.functions import BaseFunction, Function
from numba.np import arrayobj

import twoloop
from twoloop.kernels.compile.versions import BELOW, LEAST, check_version

ROOT = Path(__file__).parents[1]


def test_other_versions_are_refused_with_what_to_install():
    for known in ("0.61.0", "0.68.1", "0.68.0rc1"):
        check_version(known)
    for unknown in ("0.60.0", "0.69.0", "1.0.0"):
        with pytest.raises(ImportError, match=r"numba .* is installed: pip install 'numba>=0\.61,<0\.69'"):
            check_version(unknown)


def test_the_versions_are_those_of_the_package():
    needed = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    least, below = (".".join(map(str, version)) for version in (LEAST, BELOW))
    assert f"numba>={least},<{below}" in needed


def test_private_parts_are_used_in_one_folder():
    folder = Path(twoloop.__file__).parent
    told = [
        str(path.relative_to(folder))
        for path in folder.rglob("*.py")
        if re.search(r"(from|import) numba\.(core|np|misc)", path.read_text())
    ]
    assert [name for name in told if not name.startswith("kernels/compile/")] == []


def test_numba_is_its_own_after_kernels_were_compiled_or_read():
    from twoloop.kernels import advance

    assert advance.advance.overloads
    assert arrayobj.fix_integer_index.__module__ == "numba.np.arrayobj"
    assert "get_call_type" not in vars(Function) and Function.get_call_type is BaseFunction.get_call_type
