"""`python -m querysplat_cli` is `querysplat`."""

from querysplat_cli.cli import main

if __name__ == "__main__":
    main()
