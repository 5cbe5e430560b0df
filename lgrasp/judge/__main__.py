"""``python -m lgrasp.judge SHARDS...``"""

import typer

from lgrasp.judge.command import command

if __name__ == "__main__":
    typer.run(command)
