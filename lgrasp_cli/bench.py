"""``lgrasp bench``: how fast, on this machine; its commands compare published figures with ours."""

from pathlib import Path
from tempfile import gettempdir
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from lgrasp.choices import EngineName, Policy, ProtocolName
from lgrasp_cli.names import NETWORK, OBJECT, PIPELINE, one_of
from lgrasp_cli.options import (
    CacheDir,
    Device,
    Hand,
    JsonPath,
    Quiet,
    Seed,
    Settings,
    Workers,
    check_report,
    choose_pipeline,
    given,
    open_cache,
    set_option,
    split,
    warn,
)
from lgrasp_cli.progress import say
from lgrasp_cli.tables import Block, TextTable, print_report

if TYPE_CHECKING:
    from lgrasp.bench.comparison import Table as Comparison
    from lgrasp.bench.page import Page
    from lgrasp.engine.cache import Cache
    from lgrasp.jobs.config import JobConfig

app = typer.Typer(
    name="bench", invoke_without_command=True, subcommand_metavar="[table1|sequence|refine|soak [OPTIONS]]"
)

_List = Annotated[str | None, Option(help="Names or files, separated by commas.", show_default="the published")]
_ObjectDir = Annotated[Path | None, Option(help="Folder where the names of objects are looked up first.")]
_Resume = Annotated[bool, Option("--resume", help="Keep the results that --json PATH already holds.")]
_Repeat = Annotated[int, Option(min=1, help="Runs of each pipeline and object.")]


@app.callback()
def bench(
    context: typer.Context,
    hand: Hand = "allegro",
    objects: Annotated[str, Option(help="Names or mesh files, separated by commas.")] = "mug",
    pipelines: Annotated[str, Option(help="Names or YAML files, separated by commas.")] = "robust,swift,lightning",
    rows: Annotated[int, Option("-n", "--rows", help="Grasps per run.")] = 2000,
    repeat: _Repeat = 3,
    object_dir: _ObjectDir = None,
    settings: Settings = None,
    seed: Seed = None,
    device: Device = "auto",
    workers: Workers = 0,
    json_path: JsonPath = None,
) -> None:
    """Compare pipelines by strict-valid grasps per second, from placement through filter.

    The pipelines take turns on each object; ratios are relative to the last one. Only compiled kernels are kept.

    Example: lgrasp bench --objects mug,bowl --repeat 5
    """
    if context.invoked_subcommand:
        _refuse_options(context)
        return
    from lgrasp.config import parse_model
    from lgrasp.jobs.config import JobConfig

    what = given(hands=[hand], objects=split(objects), object_dir=object_dir, pipelines=split(pipelines), rows=rows)
    how = given(settings=settings, seed=seed, device=device, workers=workers)
    config = parse_model(JobConfig, what | how, "bench")
    check_report(json_path)
    _check(config)
    cache = open_cache(None)
    from lgrasp.bench.comparison import new_table

    _print_comparison(_measure(new_table(config, repeat=repeat, baseline_rows=rows), config, cache), json_path)


@app.command()
def table1(
    hands: _List = None,
    objects: _List = None,
    hand_dir: Annotated[Path | None, Option(help="Folder where NAME/NAME.urdf is looked up first.")] = None,
    object_dir: _ObjectDir = None,
    pipelines: Annotated[
        str | None,
        Option(
            help="Names or files; the last of several is the baseline.", show_default="those of configs/table1.yaml"
        ),
    ] = None,
    rows: Annotated[int | None, Option("-n", "--rows", min=1, help="Grasps per run.", show_default="2000")] = None,
    baseline_rows: Annotated[
        int | None, Option("--baseline-n", min=1, help="Grasps per run of the baseline.", show_default="a tenth of -n")
    ] = None,
    repeat: _Repeat = 3,
    shard_rows: Annotated[
        int | None, Option(min=1, help="Rows of a shard; large ones fill a GPU.", show_default="10000")
    ] = None,
    settings: Settings = None,
    seed: Seed = None,
    device: Device = "auto",
    workers: Workers = 0,
    json_path: JsonPath = None,
    plot: Annotated[Path | None, Option(metavar="FILE.png", help="Also draw the table as bars.")] = None,
    resume: _Resume = False,
) -> None:
    """Measure the table of Lightning Grasp: four hands, eight objects, our pipelines next to the published figures.

    A cell is a hand with an object; --json PATH is written after each, so an interrupted run loses at most one cell.
    configs/table1.yaml lists the hands and objects; without --hand-dir the hands have primitive geometry.

    Example: lgrasp bench table1 --hand-dir hands --object-dir meshes --json table1.json --plot table1.png
    """
    from lgrasp.config import parse_model
    from lgrasp.jobs.config import JobConfig, load_config

    names = {"hands": hands, "objects": objects, "pipelines": pipelines}
    what = {name: split(text) for name, text in names.items() if text}
    what |= given(hand_dir=hand_dir, object_dir=object_dir, rows=rows, shard_rows=shard_rows)
    how = given(settings=settings, seed=seed, device=device, workers=workers)
    config = parse_model(JobConfig, load_config("table1").model_dump() | what | how, "bench table1")
    file = _written(json_path, resume)
    _check(config)
    cache = open_cache(None)
    from lgrasp.bench.charts import draw_table
    from lgrasp.bench.comparison import new_table, read_table, without_missing
    from lgrasp.bench.page import load_published
    from lgrasp.picture.sheet import check_image

    if plot:
        check_image(plot, (".png",))
    if not objects:
        config, missing = without_missing(config)
        if missing:
            warn(f"left out {', '.join(missing)}: not shipped with lgrasp; --object-dir names a folder that has them")
    baseline = baseline_rows or max(1, config.rows // 10)
    table = new_table(config, repeat=repeat, baseline_rows=baseline, published=load_published("lightning"))
    if resume and file:
        table = read_table(Path(file), table)
    table = _measure(table, config, cache, file)
    if plot:
        draw_table(table, plot)
    _print_comparison(table, json_path)


@app.command("sequence")
def bench_sequence(
    objects: Annotated[
        list[str] | None,
        Argument(
            help="Pool of objects: mesh files or names.", show_default="mug sphere box capsule bottle bowl", **OBJECT
        ),
    ] = None,
    hand: Hand = "allegro",
    length: Annotated[int, Option(min=2, help="Objects in a sequence.")] = 4,
    sequences: Annotated[int, Option(min=1, help="Sequences of objects, drawn from the pool.")] = 3,
    width: Annotated[int, Option("-n", "--width", min=1, help="Attempts started with each sequence.")] = 256,
    methods: Annotated[str, Option(help="Methods, separated by commas.")] = "field,anneal",
    baseline_width: Annotated[int, Option("--baseline-n", min=1, help="Attempts of methods after the first.")] = 32,
    iterations: Annotated[
        int | None, Option(min=1, help="Iterations of the optimiser; default: as published.", show_default="6000")
    ] = None,
    policy: Annotated[str, Option(**one_of(Policy, "POLICY", "uniform is as published."))] = "uniform",
    simulate: Annotated[
        str, Option(**one_of(ProtocolName, "PROTOCOL", "Protocol (seq6: friction 2.0, as published)."))
    ] = "seq6",
    scale: Annotated[str, Option(help="Factor to metres, or range of the longest side in metres.")] = "0.06:0.10",
    pipeline: Annotated[
        str, Option("--pipeline", "-p", help="Name of a sequence pipeline, or a YAML file.", **PIPELINE)
    ] = "sequence",
    model: Annotated[
        str | None,
        Option(help="Also draw with this network, a file or a name from learn list (pipeline sample).", **NETWORK),
    ] = None,
    settings: Settings = None,
    seed: Annotated[int, Option(min=0, help="Seed of the sequences and the grasps.")] = 0,
    device: Device = "auto",
    workers: Workers = 0,
    json_path: JsonPath = None,
    cache_dir: CacheDir = None,
    resume: _Resume = False,
) -> None:
    """Measure the tables of SeqGrasp: success by opposition space and number of objects, for each method.

    Every row is simulated, and only rows that hold are continued. All methods go through one sequence before the next;
    --json PATH is written after each method.

    Example: lgrasp bench sequence --sequences 2 --methods field
    """
    file = _written(json_path, resume)
    from lgrasp.config import parse_model
    from lgrasp.jobs.requests.search import SampleRequest, SequenceRequest
    from lgrasp.jobs.sets import SequenceSets, object_sequences

    pool = objects or ["mug", "sphere", "box", "capsule", "bottle", "bowl"]
    sets = parse_model(SequenceSets, {"sets": sequences, "length": length, "permutations": 1}, "bench sequence")
    chosen = choose_pipeline(pipeline, seed, settings=settings)
    optimiser = chosen.params("sequence").optimiser.model_dump() | given(iterations=iterations)
    chosen = chosen.with_params("sequence", policy=policy, width=width, optimiser=optimiser)
    for method in split(methods):
        chosen.with_params("sequence", method=method)
    how: dict[str, Any] = {"scale": scale, "simulate": simulate, "device": device, "workers": workers}
    how |= {"hand": hand, "rows": 1, "pipeline": chosen, "out": gettempdir()}  # nothing is written there
    drawn = object_sequences(pool, sets, seed)
    asked = [parse_model(SequenceRequest, how | {"objects": names}, "bench sequence") for names in drawn]
    if model is not None:
        own = choose_pipeline("sample", seed, settings=settings).with_params("sequence", policy=policy, width=width)
        how |= {"pipeline": own, "model": model}
        asked += [parse_model(SampleRequest, how | {"objects": names}, "bench sequence") for names in drawn]
    for request in asked:
        request.check()
    cache = open_cache(cache_dir)
    from lgrasp.bench.sequence import bench_methods, read_parts, sequence_page
    from lgrasp.engine.report import write_json

    jobs, result = [request.job(cache) for request in asked], {}
    parts = read_parts(Path(file)) if resume and file else {}
    for result in bench_methods(jobs[: len(drawn)], split(methods), baseline_width, say, jobs[len(drawn) :], parts):
        if file:
            write_json(file, result | {"set": settings or []})
    _print(result | {"set": settings or []}, json_path, sequence_page(result))


@app.command("refine")
def bench_refine(
    hands: Annotated[str, Option(help="Names, separated by commas.")] = "barrett,schunk_svh",
    objects: Annotated[str, Option(help="Names or mesh files, separated by commas.")] = "bowl,box,bottle,mug",
    starts: Annotated[int, Option("--starts", "-n", min=1, help="Starts on each object.")] = 80,
    simulate: Annotated[str, Option(**one_of(ProtocolName, "PROTOCOL", "Decides which plans are valid."))] = "dipgrasp",
    engine: Annotated[str, Option(**one_of(EngineName, "ENGINE", "Simulator."))] = "mujoco",
    noise: Annotated[bool, Option("--noise/--no-noise", help="Also measure table IV: clouds with noise.")] = True,
    settings: Annotated[
        list[str] | None,
        set_option(help="Set a parameter of the plans, such as bounds.friction=0.8 or plan.finalists=5; repeatable."),
    ] = None,
    device: Device = "auto",
    json_path: JsonPath = None,
    cache_dir: CacheDir = None,
) -> None:
    """Measure tables I, III and IV of DiPGrasp: plans on meshes and noisy clouds, and coarse poses refined.

    Plans are made with one hand at each start, as published, and with the best of several. A plan is valid if it
    holds its object in simulation: dipgrasp is the paper's own test, success the share of the plans that pass it.

    Example: lgrasp bench refine --objects bottle,mug --starts 40
    """
    check_report(json_path)
    from lgrasp.hand.names import hand_path
    from lgrasp.jobs.requests.plan import plan_params
    from lgrasp.jobs.requests.shards import look_up
    from lgrasp.object.find import find_object

    params = plan_params(settings or ())
    for names, find in ((hands, hand_path), (objects, find_object)):
        for name in split(names):
            look_up(name, find)
    cache = open_cache(cache_dir)
    from lgrasp.bench.refine import NOISES, bench_hands, refine_page

    how: dict[str, Any] = {"engine": engine, "params": params, "noises": NOISES if noise else ()}
    how |= {"device": device, "cache": cache, "progress": say}
    result = bench_hands(split(hands), split(objects), starts, simulate, **how)
    result["set"] = settings or []
    _print(result, json_path, refine_page(result))


@app.command("soak")
def bench_soak(
    rounds: Annotated[int, Option(min=1, help="How often every command is ended by every signal.")] = 1,
    hours: Annotated[float, Option(min=0, help="Continue for this long, however many rounds that takes.")] = 0.0,
    seed: Annotated[int, Option(min=0, help="Seed of the random moments.")] = 0,
    commands: Annotated[str | None, Option(help="Commands, separated by commas.", show_default="all")] = None,
    signals: Annotated[str | None, Option(help="Ways to end them, separated by commas.", show_default="all")] = None,
    json_path: JsonPath = None,
    quiet: Quiet = False,
) -> None:
    """Kill each command that writes files at random moments, rerun it, and compare with an uninterrupted run.

    Small runs, each a process in a temporary folder. Reported are files that differ or are left over, processes that
    are still there after a minute, and wrong exit codes; exit code 1 if there is any of that. --json PATH is written
    after each.

    Example: lgrasp bench soak --hours 2 --json soak.json
    """
    file = _written(json_path)
    from lgrasp.bench.soak.report import run_soak, soak_page
    from lgrasp.engine.report import write_json

    chosen = [split(names) if names else () for names in (commands, signals)]
    result: dict[str, Any] = {}
    for result in run_soak(*chosen, rounds=rounds, hours=hours, seed=seed, **({} if quiet else {"say": say})):
        if file:
            write_json(file, result)
    if quiet:
        print_report(result, json_path, ())
    else:
        _print(result, json_path, soak_page(result))
    if result["faults"]:
        raise typer.Exit(1)


def _written(json_path: str | None, resume: bool = False) -> str | None:
    """The file that is written as the benchmark goes on; an error if it cannot be, or is to be resumed and is none."""
    if resume and json_path in (None, "-"):
        from lgrasp.errors import ConfigError

        raise ConfigError("--resume needs the file to continue: --json PATH")
    check_report(json_path)
    return None if json_path == "-" else json_path


def _print(result: Any, json_path: str | None, page: "Page") -> None:
    blocks: list[Block] = [*page.head]
    for table in page.tables:
        title = f"\n{table.title}" if table.title else ""
        blocks += [title, TextTable(table.columns, table.rows, table.columns[table.texts :])]
    print_report(result, json_path, [*blocks, "", *page.notes])


def _check(config: "JobConfig") -> None:
    """Raises the first problem where nothing that is to be measured can be."""
    from lgrasp.errors import LgraspError
    from lgrasp.jobs.config import plan_requests

    problems = []
    for request in plan_requests(config):
        try:
            request.model_copy(update={"out": Path(gettempdir())}).check()  # nothing is written to its own
            return
        except LgraspError as problem:
            problems.append(problem)
    raise problems[0]


def _refuse_options(context: typer.Context) -> None:
    """Options before the name of a subcommand would have no effect."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    if any(source is not None and source.name == "COMMANDLINE" for source in sources.values()):
        name = context.invoked_subcommand
        raise typer.BadParameter(f"options of 'bench {name}' come after its name: lgrasp bench {name} --device cpu")


def _measure(table: "Comparison", config: "JobConfig", cache: "Cache", file: str | None = None) -> "Comparison":
    """The table with all its cells; written to the file after each."""
    from lgrasp.bench.comparison import cell_line, measure_table
    from lgrasp.engine.report import write_json

    for latest, cell in measure_table(table, config, cache, progress=say):
        table = latest
        if file:
            write_json(file, table)
        say(cell_line(table, cell))
    return table


def _print_comparison(table: "Comparison", json_path: str | None) -> None:
    """Print a table; the exit code is that of bad input if no cell could be measured."""
    from lgrasp.bench.comparison import comparison_page
    from lgrasp.errors import ConfigError

    _print(table, json_path, comparison_page(table))
    errors = [cell["error"] for cell in table["cells"]]
    if all(errors):
        raise ConfigError(f"no cell could be measured: {errors[0]}")
