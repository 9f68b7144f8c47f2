"""Machine code on disk is read again only where all numbers and helpers that it encloses are the same."""

import runpy
import sys

import pytest

SCRIPT = """
import sys, types
import numpy as np
from numba import njit
from numba.extending import register_jitable
from twoloop import callback

g = float(sys.argv[1])

@njit
def heavy(t):
    return 9.81 + 0.0 * t

@njit
def light(t):
    return 4.0 + 0.0 * t

@njit
def of_g(t):
    return g + 0.0 * t

@register_jitable
def registered(t):
    return g + 0.0 * t

@njit
def pull_of(place, t):
    return place.pull + 0.0 * t

def made(how):
    shop = types.ModuleType("shop")
    shop.pull, tables = g, ((np.array([g]),), 1.0)
    laws = (heavy, light, heavy if g == 9.81 else light)
    def in_module(t, q, v, p, Q):
        Q[0] = -shop.pull
    def in_tuple(t, q, v, p, Q):
        Q[0] = -tables[0][0][0]
    def again(t, q, v, p, Q):
        Q[0] = -laws[2](t) + 0.0 * heavy(t) + 0.0 * light(t)
    def of_helper(t, q, v, p, Q):
        Q[0] = -of_g(t)
    def of_registered(t, q, v, p, Q):
        Q[0] = -registered(t)
    def module_as_argument(t, q, v, p, Q):
        Q[0] = -pull_of(shop, t)
    return callback("force")(locals()[how])

def values(how):
    Q, function = np.zeros(1), made(how)
    function(0.0, np.zeros(1), np.zeros(1), np.zeros(0), Q)
    return -Q[0]

hows = "in_module", "in_tuple", "again", "of_helper", "of_registered", "module_as_argument"
print(*map(values, hows))
if g == 9.81:
    g = 5.0  # a helper that numba has compiled by now
    print(values("of_helper"), values("of_registered"))
"""


@pytest.mark.filterwarnings("ignore:First-class function type feature is experimental")
def test_machine_code_on_disk_is_that_of_the_same_values(tmp_path, monkeypatch, capsys):
    """Each run of the script makes all functions anew, as a process does: only the disk knows of those before."""
    numbers = {"9.81": [9.81] * 6 + [5.0] * 2, "4.0": [4.0] * 6, "5.0": [5.0, 5.0, 4.0, 5.0, 5.0, 5.0]}
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    for g, values in numbers.items():
        monkeypatch.setattr(sys, "argv", [str(script), g])
        runpy.run_path(str(script), run_name="script")
        assert [float(each) for each in capsys.readouterr().out.split()] == values
