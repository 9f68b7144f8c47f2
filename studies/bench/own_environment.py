"""The environment of a file with an inline header of dependencies (PEP 723).

What the header names is installed there, on top of the present one, which has everything else: numpy and twoloop.
"""

import hashlib
import json
import os
import re
import shutil
import site
import subprocess
import sys
import sysconfig
import tomllib
import venv
from pathlib import Path

from packaging.specifiers import SpecifierSet

from studies.bench.cli import StudyError

HEADER = re.compile(r"(?m)^# /// script\s*$\n(?P<body>(^#(| .*)$\n)+?)^# ///\s*$")  # as PEP 723 has it


def dependencies(text: str, path: Path) -> list[str] | None:
    """What the inline header of a file asks for; None where there is none.

    Raises StudyError if there are several, it is no TOML, or it asks for another version of Python.
    """
    found = list(HEADER.finditer(text))
    if not found:
        return None
    if len(found) > 1:
        raise StudyError(f"{path} has {len(found)} headers '# /// script'; PEP 723 allows one")
    lines = (line.removeprefix("#").removeprefix(" ") for line in found[0]["body"].splitlines())
    try:
        header = tomllib.loads("\n".join(lines))
        wanted, asked = SpecifierSet(header.get("requires-python", "")), list(header.get("dependencies", []))
        if not all(isinstance(each, str) for each in asked):
            raise ValueError(f"dependencies must be a list of texts; given {asked}")
    except (ValueError, TypeError) as error:
        raise StudyError(f"the header '# /// script' of {path} cannot be read: {error}") from None
    if (running := ".".join(map(str, sys.version_info[:3]))) not in wanted:
        raise StudyError(f"{path} asks for Python {wanted}; this is {running}")
    return asked


def environment(wanted: list[str] | None) -> str:
    """The Python of an environment with these packages on top of the present one, made when first asked for.

    Raises StudyError if a package cannot be installed.
    """
    if wanted is None:
        return sys.executable
    key = hashlib.sha256(json.dumps([2, sys.prefix, sys.version, sorted(wanted)]).encode()).hexdigest()[:16]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "twoloop" / "environments" / key
    python = folder / "bin" / "python"
    if (folder / "complete").is_file():
        return str(python)
    shutil.rmtree(folder, ignore_errors=True)
    venv.create(folder, with_pip=False, symlinks=True)
    packages = sysconfig.get_path("purelib", "venv", {"base": str(folder), "platbase": str(folder)})
    present = dict.fromkeys([*site.getsitepackages(), sysconfig.get_path("platlib")])
    # by a call, so that .pth files of the present environment are read, by which editable installs are found
    Path(packages, "present.pth").write_text("".join(f"import site; site.addsitedir({each!r})\n" for each in present))
    if wanted:
        uv = shutil.which("uv")
        install = [uv, "pip", "install", "-q", "--python", str(python)] if uv else [sys.executable, "-m", "pip", "-q"]
        install += [] if uv else ["--disable-pip-version-check", "--python", str(python), "install"]
        done = subprocess.run([*install, *wanted], capture_output=True, text=True)
        if done.returncode:
            said = (done.stderr or done.stdout).strip().splitlines()[-1:]
            raise StudyError(f"the environment with {', '.join(wanted)} cannot be made: {' '.join(said)}")
    (folder / "complete").touch()
    return str(python)
