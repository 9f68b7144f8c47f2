"""python -m twoloop: info, compile, solve."""

import sys
from pathlib import Path

import numpy as np
import pytest

import twoloop
from twoloop import kernels
from twoloop.__main__ import main
from twoloop.kernels.compile.caches import cache_folder
from twoloop.mechanisms import four_bar

pd = pytest.importorskip("pandas")  # not among the oldest versions
pytest.importorskip("matplotlib")
FILE = """
from twoloop.mechanisms import four_bar, heavy_top
import dataclasses
import twoloop
def linkage():
    return four_bar()
def bare():
    return dataclasses.replace(four_bar(), drawing=None)
def steep():
    return four_bar(theta3=2.0)
def number():
    return 3
def mass(t, q):
    return [[1.0]]
"""


@pytest.fixture
def where(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(FILE)
    return f"{path}:linkage"


def ended(words):
    """What the process says as it ends, and its status."""
    with pytest.raises(SystemExit) as end:
        main(words)
    return end.value.code


def test_info(capsys):
    main(["info"])
    text = capsys.readouterr().out
    assert f"twoloop {twoloop.__version__}, Python {sys.version.split()[0]}" in text
    assert f"numpy {np.__version__}" in text
    assert str(cache_folder(kernels)) in text and "compiled functions" in text and "cores" in text


def test_compile_imports_and_names_every_file(monkeypatch, capsys):
    imported = []  # and not compiled: slow tests alone need some kernels
    monkeypatch.setattr("twoloop.__main__.import_module", imported.append)
    main(["compile"])
    lines = capsys.readouterr().out.splitlines()
    folder = Path(kernels.__file__).parent
    files = {path.relative_to(folder).with_suffix("") for path in folder.rglob("*.py") if path.stem != "__init__"}
    names = {".".join(path.parts) for path in files}
    assert {line.split()[3] for line in lines[:-1]} == names and lines[-1].startswith("ready after")
    assert {name.removeprefix(f"{kernels.__name__}.") for name in imported} == names


def test_solve_writes_what_the_endings_say(where, tmp_path, capsys):
    files = [str(tmp_path / name) for name in ("run.csv", "run.parquet", "run.PNG", "run.html", "run.npz")]
    main(["solve", where, "--method", "Gauss8", "--rtol", "1e-9", "--t-end", "0.3", "--out", *files])
    text = capsys.readouterr().out
    assert "Gauss8: REACHED_END. Reached the end, t = 0.3" in text
    assert [line for line in text.splitlines() if line.startswith("wrote")] == [f"wrote {file}" for file in files]
    problem = four_bar()
    alone = twoloop.solve_dae(problem.system, (0.0, 0.3), problem.q0, problem.v0, method="Gauss8", rtol=1e-9)
    for table in (pd.read_csv(files[0], index_col=0), pd.read_parquet(files[1])):
        np.testing.assert_array_equal(table["angle (rad) of bar 3"], alone.q[8])
    np.testing.assert_array_equal(twoloop.load(files[4]).q, alone.q)
    assert Path(files[2]).read_bytes().startswith(b"\x89PNG") and "<canvas" in Path(files[3]).read_text()


def test_a_failed_run_ends_with_one(where, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("twoloop.__main__.solve_dae", lambda *words, **options: stopped)
    problem = four_bar()
    stopped = twoloop.solve_dae(problem.system, (0.0, 1.0), problem.q0, problem.v0, max_steps=3)
    assert ended(["solve", where, "--out", str(tmp_path / "run.csv")]) == 1
    assert "MAX_STEPS" in capsys.readouterr().out and len(pd.read_csv(tmp_path / "run.csv")) == 4


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["solve", "mine.py"], "give FILE.py:FUNCTION, such as crane.py:crane, or a ready mechanism"),
        (["solve", "fuor_bar"], "there is no mechanism fuor_bar among ancf_beam, andrews, bricard, "),
        (["solve", "ancf_beam"], "ancf_beam must be a function without arguments that returns a twoloop.mechanisms.P"),
        (["solve", "{mine}:mass"], "mass must be a function without arguments that returns a twoloop.mechanisms.Prob"),
        (["solve", "nothing.py:linkage"], "there is no file"),
        (["solve", "{mine}:lonkage"], "has no function lonkage"),
        (["solve", "{mine}:number"], "must return a twoloop.mechanisms.Problem; it returned int"),
        (["solve", "{mine}:steep"], "the linkage cannot be assembled"),
        (["solve", "{mine}:linkage", "--rtol", "-1"], "rtol must be positive"),
        (["solve", "{mine}:linkage", "--out", "run.xls"], "--out takes files that end in .csv, .parquet,"),
        (["solve", "{mine}:linkage", "--out", "nowhere/run.csv"], "--out: there is no folder"),
        (["solve", "{mine}:bare", "--out", "run.html"], "makes a problem without a drawing"),
    ],
)
def test_mistakes_are_one_line(where, words, says):
    mine = where.rpartition(":")[0]
    end = ended([word.format(mine=mine) for word in words])
    assert end.startswith("error: ") and says in end and "\n" not in end


@pytest.mark.parametrize(("name", "module", "package"), [("run.csv", "pandas", "pandas"), ("run.gif", "PIL", "pillow")])
def test_packages_for_the_files_are_looked_for_before_the_run(where, monkeypatch, tmp_path, name, module, package):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr("twoloop.__main__.solve_dae", lambda *words, **options: pytest.fail("it ran"))
    path = tmp_path / name
    assert ended(["solve", where, "--out", str(path)]) == (
        f"error: --out {path} needs the package {package}: pip install {package}"
    )
