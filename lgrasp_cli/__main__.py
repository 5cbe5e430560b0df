"""``python -m lgrasp_cli``."""

from lgrasp_cli.main import main

__all__: list[str] = []

if __name__ == "__main__":
    main()
