"""``lgrasp pipelines``: the pipelines there are."""

from typing import Annotated

import typer
from typer import Argument

from lgrasp_cli.tables import Answer, TextTable, reporting

app = typer.Typer(help="List and show pipelines.", no_args_is_help=True)


@app.command("list")
@reporting
def list_pipelines() -> Answer:
    """List the pipelines that can be used by name.

    Example: lgrasp pipelines list
    """
    from lgrasp.jobs.listing import list_pipelines as listed

    pipelines = listed()
    rows = [(p["name"], ", ".join(p["stages"]), p["description"]) for p in pipelines]
    return Answer(pipelines, [TextTable(("name", "stages", "description"), rows)])


@app.command("show")
@reporting
def show_pipeline(name: Annotated[str, Argument(help="Name of a pipeline, or a YAML file.")]) -> Answer:
    """Show every parameter of a pipeline with its value and meaning.

    Example: lgrasp pipelines show swift
    """
    from lgrasp.jobs.listing import describe_pipeline

    data = describe_pipeline(name)
    head = f"{data['name']}: {data['description']}" if data["description"] else data["name"]
    rows = [
        (part, key, " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value), words)
        for part, key, value, words in data["parameters"]
    ]
    return Answer(data, [head, TextTable(("part", "parameter", "value", "meaning"), rows, right=("value",))])
