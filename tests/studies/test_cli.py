"""How studies are called: options, one-line errors, Ctrl-C."""

import pytest

from studies.bench import cli
from studies.bench.cli import REPORTS, StudyError


def test_options_have_their_defaults(tmp_path):
    assert cli.parse("x", "What.", []).out == REPORTS and cli.parse("x", "What.", ["--quick"]).out == REPORTS / "quick"
    call = cli.parse("x", "What.", ["--redraw", "--out", str(tmp_path)])
    assert call.redraw and not call.quick and call.out == tmp_path
    assert call.command == f"python -m studies.x --redraw --out {tmp_path}"


def test_help_says_what_the_study_is(capsys):
    with pytest.raises(SystemExit) as end:
        cli.parse("x", "What it asks.", ["--help"])
    assert end.value.code == 0 and "What it asks." in capsys.readouterr().out


def test_errors_and_ctrl_c_end_with_one_line(capsys):
    def fails(words):
        raise StudyError("the folder is in use")

    def stopped(words):
        raise KeyboardInterrupt

    with pytest.raises(SystemExit, match=r"^error: the folder is in use$"):
        cli.main(fails, [])
    with pytest.raises(SystemExit) as end:
        cli.main(stopped, [])
    said = capsys.readouterr().err
    assert end.value.code == 130 and said.count("\n") == 1 and "the same command continues" in said


def test_a_processor_is_named_with_its_vectors_and_its_family_where_its_name_is_short():
    assert cli.generation({"model name": "AMD EPYC", "cpu family": "26", "model": "2"}) == ["cpu family 26 model 2"]
    assert cli.generation({"model name": "a machine without families"}) == []
    known = {"model name": "AMD EPYC", "cpu family": "26", "model": "2", "flags": "fpu avx2 avx512f"}
    assert cli.named(known) == "AMD EPYC with AVX-512 (family 26 model 2)"
    assert cli.named({"model name": "Xeon 8481C", "cpu family": "6"}) == "Xeon 8481C" and cli.named({}) == ""


def test_the_stamp_is_one_line():
    line = cli.stamp("python -m studies.x")
    assert line.startswith("`python -m studies.x`; ") and "\n" not in line and "numba" in line and "commit" in line
