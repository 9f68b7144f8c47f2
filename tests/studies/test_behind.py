"""Where the default's time goes in the pairs in which it is behind, from rows made by hand."""

import pandas as pd
import pytest

from studies.work_precision import behind, rivals
from tests.studies.test_minimal import repeated
from tests.studies.test_rivals import stated


def pairs(inside, rival=2.0):
    """The default takes 4 s for an error of 1e-6, `inside` of them in its steps; heyoka takes less."""
    own = repeated(("auto, compiled", 1e-6, 4.0)).assign(inside_s=inside, n_steps=8.0)
    return pd.concat([own, repeated(("heyoka", 1e-6, rival), family="heyoka").assign(n_steps=60.0)], ignore_index=True)


@pytest.mark.parametrize(
    ("inside", "rival", "parts"),
    [
        (0.5, 2.0, {"steps": 0, "each": 0, "outside": 1, "together": 0}),
        (3.0, 2.0, {"steps": 1, "each": 0, "outside": 0, "together": 0}),
        (2.5, 1.0, {"steps": 1, "each": 1, "outside": 0, "together": 0}),
        (2.5, 3.0, {"steps": 0, "each": 0, "outside": 0, "together": 1}),
    ],
)
def test_what_takes_longer_than_the_rival_is_told(inside, rival, parts):
    rows = pairs(inside, rival)
    found = behind.findings_of(rivals.findings_of(rows)["mechanisms"], rows)
    assert found["n"] > 0 and found["parts"] == {name: n * found["n"] for name, n in parts.items()}
    (at,) = found["at"]
    assert (at["steps_s"], at["n_steps"], at["rival_s"], at["rival_steps"]) == (inside, 8, rival, 60)


def test_the_report_has_the_counts():
    rows = pairs(0.5)
    found = behind.findings_of(rivals.findings_of(rows)["mechanisms"], rows)
    said = f"In 0 of the {found['n']} pairs in which the default is behind, its steps alone"
    assert said in stated(1.0, behind=found)
    assert "## Where the default's time goes" not in stated(1.0)
