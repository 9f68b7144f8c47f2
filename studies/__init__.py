"""Studies: `python -m studies.NAME [--quick] [--out DIR] [--redraw]`; `python -m studies` lists them."""
