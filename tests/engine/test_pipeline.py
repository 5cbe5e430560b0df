"""Pipelines: what is accepted, what errors say, and what enters the content keys."""

import json
from dataclasses import replace
from typing import Any, get_args

import pytest
import yaml
from pydantic import BaseModel

from lgrasp.engine.inputs import input_keys, run_key
from lgrasp.engine.pipeline import load_pipeline, pipeline_files
from lgrasp.engine.registry import ORDERS, STAGES
from lgrasp.errors import ConfigError
from lgrasp.hand.find import find_hand
from lgrasp.object.find import find_object
from lgrasp.policy.names import SHIPPED


def declared(**changes: Any) -> dict[str, Any]:
    return {"name": "mine", "stages": [{name: {}} for name in ORDERS[0]]} | changes


@pytest.fixture
def load_text(tmp_path):
    def load(data: Any):
        path = tmp_path / "mine.yaml"
        path.write_text(data if isinstance(data, str) else yaml.safe_dump(data))
        return load_pipeline(str(path))

    return load


def stages(**params: dict[str, Any]) -> dict[str, Any]:
    return declared(stages=[{name: params.get(name, {})} for name in ORDERS[0]])


@pytest.mark.parametrize("name", sorted(pipeline_files()))
def test_shipped_pipelines_load(name):
    pipeline = load_pipeline(name)
    assert pipeline.name == name
    assert pipeline.description
    assert any(pipeline.order[: len(order)] == order for order in ORDERS)
    assert json.loads(json.dumps(pipeline.describe())) == pipeline.describe()


def test_a_stage_may_be_written_without_parameters(load_text):
    assert load_text(declared(stages=[{n: None} for n in ORDERS[1]])).order == ORDERS[1]


def test_a_section_may_have_no_lines_but_comments(load_text):
    assert load_text(declared(bounds=None, steer=None)) == load_text(declared())


def test_another_profile_keeps_the_numbers_that_were_given():
    robust = load_pipeline("robust")
    assert robust.with_settings(["bounds.profile=strict"]) == robust
    plan = robust.with_settings(["bounds.profile=plan", "bounds.max_gswo=0.2"]).bounds
    assert (plan.friction, plan.max_unresisted_load) == (robust.bounds.friction, robust.bounds.max_unresisted_load)
    assert (plan.max_gap, plan.max_gswo) == (0.004, 0.2)


def test_objects_of_sequences_touch_their_opposition_space_only(load_text):
    for data in (stages(filter={"contacts": "all"}), declared(stages=[{n: None} for n in ORDERS[1]])):
        with pytest.raises(ConfigError, match=r"opposition space only; leave out stage wrap and filter\.contacts"):
            load_text(data | {"sequence": {}})


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (declared(sede=1), ["sede", "did you mean 'seed'"]),
        ({"naem": "x", "stages": []}, ["naem", "did you mean 'name'"]),
        ({"name": "x"}, ["stages", "missing"]),
        (stages(place={"proposal": 3}), ["proposal", "did you mean 'proposals'", "place"]),
        (stages(search={"score": "best"}), ["score", "best", "fswo"]),
        (stages(search={"restarts": "many"}), ["restarts", "many"]),
        (stages(search={"restarts": True}), ["restarts", "True, not a number"]),
        (stages(search={"contacts": [3, True]}), ["contacts", "True], not a number"]),
        (stages(search={"contacts": [0, 3]}), ["contacts", "0", "1"]),
        (declared(bounds={"friction": True}), ["friction", "True, not a number"]),
        (declared(name="../here"), ["name '../here' cannot be used"]),
        (declared(name=""), ["name '' cannot be used"]),
        (stages(ik={"gap": -1.0}), ["gap", "-1.0"]),
        (stages(ik={"gap": [1]}), ["gap"]),
        (stages(place={"canonical": float("nan")}), ["canonical", "nan"]),
        (declared(field={"records": 1}), ["records", "1000"]),
        (declared(field={"indx": "bvh"}), ["indx", "did you mean 'index'"]),
        (declared(object={"sdf_cell": 1}), ["sdf_cell", "did you mean 'sdf_cells'"]),
        (declared(seed=-1), ["seed", "-1"]),
        (declared(effort=0), ["effort"]),
        (declared(stages=[{"plaice": {}}]), ["plaice", "did you mean 'place'"]),
        (declared(stages=[{n: {}} for n in reversed(ORDERS[0])]), ["accepted", "place, domain, ik, search, filter"]),
        (declared(stages=[{n: {}} for n in ORDERS[0][:-1]]), ["accepted"]),
        (declared(stages=[{n: {}} for n in (*ORDERS[0], "filter")]), ["accepted"]),
        (declared(stages={"place": {}}), ["stages"]),
        (declared(stages=[{"place": 3}]), ["stages"]),
        ("- a\n- b\n", ["mapping", "list"]),
        ("a: [", ["cannot be read"]),
        ("", ["mapping"]),
        ("1: 2\n", ["1"]),
    ],
)
def test_bad_files(load_text, data, words):
    with pytest.raises(ConfigError) as caught:
        load_text(data)
    text = str(caught.value)
    assert "mine.yaml" in text
    assert "\n" not in text
    assert len(text) < 1000
    for word in words:
        assert word in text, text


def test_unknown_name():
    with pytest.raises(ConfigError, match="did you mean 'swift'"):
        load_pipeline("swit")
    with pytest.raises(ConfigError, match=r"known: .*swift"):
        load_pipeline("/nowhere/at/all.yaml")


def test_with_params_checks(swift):
    assert swift.with_params("search", restarts=3).params("search").restarts == 3
    assert swift.params("search").restarts != 3
    with pytest.raises(ConfigError, match="restart"):
        swift.with_params("search", restart=3)


def test_rounds_of_contacts_need_ik_before_search(swift, lightning):
    assert swift.with_settings(["domain.rounds=2"]).params("domain").rounds == 2
    with pytest.raises(ConfigError, match=r"lightning: domain\.rounds is 2; .* drawn once"):
        lightning.with_settings(["domain.rounds=2"])


def other(value: Any, kind: Any) -> list[Any]:
    """Values to try in place of a parameter's; at least one of them is within its bounds."""
    if value is None:
        return [SHIPPED, 1]  # a policy, and how many poses it rates
    if isinstance(value, str):
        return [c for c in get_args(kind) if c != value]
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, tuple):
        return [(*value, 3)]
    if isinstance(value, int):
        return [value + 1, value * 2, value - 1]
    return [value * 0.9 or 0.01, value * 0.5 + 0.01]


def changed(model: BaseModel) -> list[tuple[str, BaseModel]]:
    """The model with each of its parameters changed in turn."""
    found = []
    for name, field in type(model).model_fields.items():
        for value in other(getattr(model, name), field.annotation):
            try:
                found.append((name, type(model).model_validate(model.model_dump() | {name: value})))
                break
            except ValueError:
                continue
        else:
            pytest.fail(f"{type(model).__name__}.{name}: no other value is valid")
    return found


def test_every_parameter_is_in_the_description(swift):
    base = json.dumps(swift.describe(), sort_keys=True)
    seen = {base}
    variants = [swift.model_copy(update={"seed": 9}), swift.model_copy(update={"effort": 9})]
    variants += [swift.model_copy(update={"object": m}) for _, m in changed(swift.object)]
    variants += [swift.model_copy(update={"field": m}) for _, m in changed(swift.field)]
    for stage in swift.order:
        variants += [swift.with_params(stage, **{n: getattr(m, n)}) for n, m in changed(swift.params(stage))]
    for variant in variants:
        seen.add(json.dumps(variant.describe(), sort_keys=True))
    assert len(seen) == len(variants) + 1


def test_description_holds_no_execution_setting(swift, job):
    text = json.dumps(swift.describe())
    for word in ("device", "batch", "workers", "path", "cache"):
        assert f'"{word}"' not in text
    assert "description" not in swift.describe()


def test_run_keys(swift, tmp_path):
    """Keys change with whatever decides the rows, and with nothing else."""
    mesh = tmp_path / "thing.obj"
    mesh.write_bytes(find_object("mug").read_bytes())

    def keys(pipeline=swift, name=str(mesh), scale=1.0, shard_rows=100):
        found = input_keys(find_hand("allegro"), name, scale, pipeline.object, pipeline.field)
        return run_key(pipeline.describe(), found, shard_rows)

    first = keys()
    (tmp_path / "elsewhere").mkdir()
    moved = tmp_path / "elsewhere" / "thing.obj"
    moved.write_bytes(mesh.read_bytes())
    assert keys(name=str(moved)) == first
    assert keys(scale=1) == first
    different = [
        first,
        keys(scale=1.5),
        keys(shard_rows=101),
        keys(swift.model_copy(update={"seed": 1})),
        keys(swift.with_params("filter", draws=3)),
        keys(name="sphere"),
    ]
    mesh.write_bytes(mesh.read_bytes() + b"# another byte\n")
    different.append(keys())
    assert len(set(different)) == len(different)


def test_object_key_ignores_the_field_and_back(swift):
    def keys(pipeline):
        return input_keys(find_hand("allegro"), "mug", 1.0, pipeline.object, pipeline.field)

    base = keys(swift)
    field = keys(swift.model_copy(update={"field": swift.field.model_copy(update={"seed": 3})}))
    obj = keys(swift.model_copy(update={"object": swift.object.model_copy(update={"crease_angle": 20.0})}))
    assert (field.hand, field.object) == (base.hand, base.object)
    assert field.field != base.field
    assert (obj.hand, obj.field) == (base.hand, base.field)
    assert obj.object != base.object
    assert replace(base) == base


def test_version_of_a_stage_is_in_the_key(swift, monkeypatch):
    before = swift.describe()
    monkeypatch.setattr("lgrasp.stages.ik.stage.VERSION", STAGES["ik"].version + 1)
    assert swift.describe() != before


def test_a_stage_is_read_by_its_old_name(tmp_path, said):
    text = pipeline_files()["swift"].read_text()
    (tmp_path / "old.yaml").write_text(f"{text.rstrip()}\n  - validate: {{protocol: gravity6}}\n")
    (tmp_path / "new.yaml").write_text(f"{text.rstrip()}\n  - simulate: {{protocol: gravity6}}\n")
    old = load_pipeline(str(tmp_path / "old.yaml"))
    assert ["stage 'validate' is now 'simulate'" in line for line in said] == [True]
    assert old == load_pipeline(str(tmp_path / "new.yaml")) == load_pipeline("swift").with_simulation("gravity6")
    assert len(said) == 1
