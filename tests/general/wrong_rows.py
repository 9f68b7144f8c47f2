"""Wrong rows: see tests/bad_input/rows.py."""

from tests.bad_input.rows import ROWS as ROWS
