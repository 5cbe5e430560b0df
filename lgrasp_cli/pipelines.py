"""``lgrasp pipelines``: the pipelines there are."""

from typing import Annotated

import typer

app = typer.Typer(help="List and show pipelines.", no_args_is_help=True)

_AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of the table.")]


@app.command("list")
def list_pipelines(as_json: _AsJson = False) -> None:
    """List the pipelines that can be used by name.

    Example: lgrasp pipelines list
    """
    from lgrasp.jobs.listing import list_pipelines as listed
    from lgrasp_cli.tables import print_json, print_table

    pipelines = listed()
    if as_json:
        print_json(pipelines)
        return
    print_table(
        ("name", "stages", "description"), [(p["name"], ", ".join(p["stages"]), p["description"]) for p in pipelines]
    )


@app.command("show")
def show_pipeline(
    name: Annotated[str, typer.Argument(help="Name of a pipeline, or a YAML file.")], as_json: _AsJson = False
) -> None:
    """Show every parameter of a pipeline with its value and meaning.

    Example: lgrasp pipelines show swift
    """
    from lgrasp.jobs.listing import describe_pipeline
    from lgrasp_cli.tables import print_json, print_table

    data = describe_pipeline(name)
    if as_json:
        print_json(data)
        return
    typer.echo(f"{data['name']}: {data['description']}" if data["description"] else data["name"])
    rows = [
        (part, key, " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value), words)
        for part, key, value, words in data["parameters"]
    ]
    print_table(("part", "parameter", "value", "meaning"), rows, right=("value",))
