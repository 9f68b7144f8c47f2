"""List the studies (`python -m studies`) or run them all (`python -m studies all [--quick] [--out DIR]`)."""

import importlib
import sys
import traceback

from studies.index import STUDIES


def main() -> None:
    words = sys.argv[1:]
    if words[:1] == ["all"]:
        run_all(words[1:])
    elif words:
        sys.exit(f"usage: python -m studies [all [--quick] [--out DIR]]; given {' '.join(words)}")
    else:
        for name in STUDIES:
            module = importlib.import_module(f"studies.{name}")
            print(f"python -m studies.{name:10s} {(module.__doc__ or '').splitlines()[0]}")


def run_all(words: list[str]) -> None:
    """Run every study; one that fails does not keep the others from running, and is named at the end."""
    failed = []
    for name in STUDIES:
        print(f"--- {name}", flush=True)
        try:
            module = importlib.import_module(f"studies.{name}")
            module.main(words, command=f"python -m studies.{name} {' '.join(words)}".strip())
        except Exception:  # a bug in one study; what is not an Exception (Ctrl-C, wrong options) ends the run
            traceback.print_exc()
            failed.append(name)
    if failed:
        sys.exit(f"{len(failed)} of {len(STUDIES)} studies failed, see above: {', '.join(failed)}")


if __name__ == "__main__":
    main()
