"""`python -m automodel`."""

from automodel.cli.main import main

if __name__ == "__main__":
    main()
