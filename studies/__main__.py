"""List the studies (`python -m studies`), run one (`python -m studies table3`) or all (`python -m studies all`)."""

import sys
import traceback

from studies.bench.study import STUDIES, module_of, run_study

USAGE = "usage: python -m studies [NAME | all | compare FILE.py:FUNCTION] [--quick] [--out DIR] [--redraw]"


def main() -> None:
    name, *words = sys.argv[1:] or [""]
    if name == "all":
        run_all(words)
    elif name in (*STUDIES, "compare"):
        run_study(name, words)
    elif name and name not in ("-h", "--help"):
        sys.exit(f"{USAGE}; given {name}, which is none of {', '.join(STUDIES)}")
    else:
        if name:
            print(USAGE)
        for study in STUDIES:
            print(f"python -m studies.{study:14s} {(module_of(study).__doc__ or '').splitlines()[0]}")


def run_all(words: list[str]) -> None:
    """Run every study; one that fails does not keep the others from running, and is named at the end."""
    failed = []
    for name in STUDIES:
        print(f"--- {name}", flush=True)
        try:
            run_study(name, words)
        except SystemExit as end:
            if not isinstance(end.code, str):  # Ctrl-C, --help, wrong options
                raise
            print(end.code, file=sys.stderr)
            failed.append(name)
        except Exception:  # a bug in one study
            traceback.print_exc()
            failed.append(name)
    if failed:
        sys.exit(f"{len(failed)} of {len(STUDIES)} studies failed, see above: {', '.join(failed)}")


if __name__ == "__main__":
    main()
