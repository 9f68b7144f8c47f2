"""Writes differential_motions.json, the motions of `test_differential.py`: python -m tests.differential_motions."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from studies.bench.sharp_forces import families
from studies.bench.sharp_motion import Motion, case, drawn_from

SEED = 24
FAMILIES = tuple(families())
FILE = Path(__file__).with_suffix(".json")


def mechanism_of(family, n_drawn):
    """The mechanism of a family: that of the last of so many draws."""
    return drawn_from(family, np.random.default_rng([SEED, FAMILIES.index(family)]), n_drawn)


def read():
    """Family to the number of draws and the motion."""
    kept = json.loads(FILE.read_text())
    return {
        name: (each["n_drawn"], Motion(np.array(each["q"]), each["apart"], each["growth"]))
        for name, each in kept.items()
    }


def main():
    made = {}
    for place, family in enumerate(FAMILIES):
        _, known, n_drawn = case(family, [SEED, place])
        made[family] = asdict(known) | {"q": known.q.round(13).tolist(), "n_drawn": n_drawn}
    FILE.write_text(json.dumps(made, indent=1))


if __name__ == "__main__":
    main()
