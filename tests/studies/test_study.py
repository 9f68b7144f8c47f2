"""What the studies with series share."""

import pandas as pd
import pytest

from studies.bench.store import key
from studies.energy import runs as energy
from studies.reproduction import motion, step_size, violation


def rows_of(study, quick):
    told = [
        {"group": run.group, "case": run.case.name, "solver": run.solver.name, **run.settings}
        for run in study.runs(quick)
    ]
    return pd.DataFrame(told)


@pytest.mark.parametrize("study", [energy, motion, step_size, violation], ids=lambda study: study.__name__)
def test_every_run_has_curves_of_its_own(study):
    for quick in (True, False):
        rows = rows_of(study, quick)
        keys = [key(row) for _, row in rows.iterrows()]
        assert len(set(keys)) == len(keys) > 1


def test_a_key_survives_the_file_of_rows(tmp_path):
    rows = rows_of(energy, True)
    rows.to_csv(tmp_path / "rows.csv", index=False)
    read = pd.read_csv(tmp_path / "rows.csv")
    assert [key(row) for _, row in read.iterrows()] == [key(row) for _, row in rows.iterrows()]
