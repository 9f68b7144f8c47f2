"""List the studies (`python -m studies`) or run them all (`python -m studies all [--quick] [--out DIR]`)."""

import importlib
import sys

STUDIES = ("linkage", "table3")


def main() -> None:
    words = sys.argv[1:]
    modules = {name: importlib.import_module(f"studies.{name}") for name in STUDIES}
    if words[:1] != ["all"]:
        if words:
            sys.exit(f"usage: python -m studies [all [--quick] [--out DIR]]; given {' '.join(words)}")
        for name, module in modules.items():
            print(f"python -m studies.{name:10s} {(module.__doc__ or '').splitlines()[0]}")
        return
    for name, module in modules.items():
        module.main([*words[1:]], command=f"python -m studies.{name} {' '.join(words[1:])}".strip())


if __name__ == "__main__":
    main()
