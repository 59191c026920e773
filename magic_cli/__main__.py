"""`python -m magic_cli`: the same as the `magic` command."""

from magic_cli.main import main

if __name__ == "__main__":
    main()
