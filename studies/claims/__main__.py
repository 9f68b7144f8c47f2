"""`python -m studies.claims`."""

from studies.claims import main

if __name__ == "__main__":
    main()
