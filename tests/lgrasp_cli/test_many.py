"""Several objects and hands in one command; words too many."""

import json
import shutil

import pytest

from lgrasp.files import discard_temporaries
from lgrasp.hand.find import find_hand
from lgrasp.object.find import find_object
from lgrasp_cli.working import run_job


@pytest.fixture
def meshes(tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    for name in ("tiny", "sphere"):
        shutil.copy(find_object(name), folder)
    (folder / "notes.txt").write_text("no mesh")
    return folder


def test_a_job_for_every_object(cli, meshes, quick, tmp_path):
    base = ("generate", "-p", quick, "-n", 4, "--device", "cpu")
    plan = cli(*base, "--object", "meshes", "--object", "tiny", "--dry-run")
    assert "have one folder" in plan.error()
    (meshes / "tiny.obj").rename(meshes / "small.obj")
    result = cli(*base, "--object", "meshes/*.obj", "--object", "tiny", "--json", tmp_path / "r.json")
    assert result.code == 0, result
    assert [line.split()[-1] for line in result.out.splitlines()[1:]] == ["done"] * 3
    data = json.loads((tmp_path / "r.json").read_text())
    assert [job["title"].split()[1] for job in data["jobs"]] == ["small", "sphere", "tiny"]
    made = sorted(path.parent.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.h5"))
    assert made == [f"grasps/allegro-{name}/quick" for name in ("small", "sphere", "tiny")]
    alone = cli(*base, "--object", "tiny", "--json", "-")  # the same folder as among others
    assert json.loads(alone.out)["present"] == 4
    info = cli("dataset", "info", "grasps", "--json", "-")
    assert sum(shard["rows"] for shard in json.loads(info.out)) == 12


def test_names_that_differ_in_case_only_are_two_where_the_disk_says_so(cli, meshes, quick, tmp_path):
    (meshes / "sphere.obj").rename(meshes / "Tiny.obj")
    plan = ("generate", "-p", quick, "-n", 4, "--device", "cpu", "--object", "meshes", "--dry-run")
    assert cli(*plan).code == 0
    (tmp_path / "grasps").mkdir()
    (tmp_path / "GRASPS").symlink_to("grasps")  # as on a disk for which these are one
    assert "have one folder" in cli(*plan).error()


def test_what_is_left_out_of_a_folder_is_told(cli, meshes, quick):
    for name in ("b.STEP", "a.dae", "paint.mtl", "paint.png"):
        (meshes / name).touch()
    base = ("generate", "-p", quick, "-n", 4, "--device", "cpu", "--dry-run", "--object")
    assert cli(*base, "meshes").err.splitlines() == [
        "warning: meshes: left out a.dae, b.STEP; accepted: .obj, .stl, .ply, .off, .glb, .gltf, .3mf"
    ]
    (meshes / "more").mkdir()
    (meshes / "tiny.obj").rename(meshes / "more" / "small.obj")
    assert "left out the meshes in more/; 'meshes/**/*' takes them too" in cli(*base, "meshes").err
    taken = cli(*base, "meshes/**/*")
    assert ("allegro-small" in taken.out, taken.err) == (True, "")


def test_a_plan_shows_the_jobs_that_fail_and_the_others(cli, meshes, quick):
    """Two of the folders are not those of this run."""
    base = ("generate", "-p", quick, "-n", 4, "--device", "cpu", "--dry-run", "--object", "meshes")
    (meshes / "x.obj").write_text("# no mesh")
    (meshes.parent / "grasps").mkdir()
    for name in ("sphere", "x"):
        (meshes.parent / "grasps" / f"allegro-{name}").touch()
    plan = cli(*base)
    assert plan.code == 2
    assert [name in line for name, line in zip(("sphere", "x"), plan.err.splitlines(), strict=True)] == [True] * 2
    assert "grasps/allegro-tiny/quick" in plan.out


def test_revisions_of_a_known_hand_are_called_as_their_files(cli, quick, tmp_path):
    for name in ("rev_a", "rev_b"):
        shutil.copy(find_hand("allegro").urdf, tmp_path / f"{name}.urdf")
    both = ("--hand", "rev_a.urdf", "--hand", "rev_b.urdf")
    plan = cli("generate", "-p", quick, "-n", 4, "--device", "cpu", "--object", "tiny", *both, "--dry-run")
    assert plan.code == 0, plan
    for name in ("rev_a", "rev_b"):
        assert f"grasps/{name}-tiny/quick" in plan.out
        assert plan.err.count(f"hand '{name}.urdf': rules (contacts, canonical box, open posture) of the known") == 1


def test_sequences_are_in_folders_of_their_hands(cli, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        shutil.copy(find_hand("allegro").urdf, tmp_path / name / "hand.urdf")
    sets = "sequences: {sets: 1, length: 2, permutations: 1}\n"
    config = f"objects: [tiny, sphere]\nrows: 4\npipelines: [sequence]\n{sets}"
    (tmp_path / "one.yaml").write_text(config + "hands: [a/hand.urdf]")
    (tmp_path / "two.yaml").write_text(config + "hands: [a/hand.urdf, b/hand.urdf]")
    plan = cli("run", "one.yaml", "--dry-run")
    assert f"grasps/{find_hand(str(tmp_path / 'a' / 'hand.urdf')).name}-" in plan.out, plan
    refused = cli("run", "two.yaml", "--dry-run")
    assert refused.code == 2
    assert "a/hand.urdf and b/hand.urdf have one folder" in refused.err.splitlines()[-1]


def test_a_job_that_breaks_does_not_end_the_others(cli, quick, monkeypatch):
    def broken(job, how):
        if "tiny" in str(job.object):
            raise ValueError("what nobody expects")
        return run_job(job, how)

    monkeypatch.setattr("lgrasp_cli.many.run_job", broken)
    objects = ("--object", "tiny", "--object", "sphere")
    made = cli("generate", *objects, "-p", quick, "-n", 4, "--device", "cpu", "--json", "-")
    assert (made.code, [job["status"] for job in json.loads(made.out)["jobs"]]) == (1, ["failed", "done"])
    assert "unexpected ValueError: what nobody expects" in made.err


def test_a_signal_while_the_last_shard_is_written_ends_all_jobs(cli, quick, monkeypatch):
    """The job is whole; no other begins."""

    def asked(job, how):
        report, outcome = run_job(job, how)
        outcome.stopped = True
        return report, outcome

    monkeypatch.setattr("lgrasp_cli.many.run_job", asked)
    objects = ("--object", "tiny", "--object", "sphere")
    made = cli("generate", *objects, "-p", quick, "-n", 4, "--device", "cpu", "--json", "-")
    data = json.loads(made.out)
    assert (made.code, data["exit_code"], [job["status"] for job in data["jobs"]]) == (130, 130, ["done"])


def test_a_process_ended_while_it_loads_reports_the_jobs_before(cli, quick, monkeypatch, tmp_path):
    def ended(job, how):
        if "sphere" in str(job.object):
            discard_temporaries()  # all that is done when a signal ends the process
        return run_job(job, how)

    monkeypatch.setattr("lgrasp_cli.many.run_job", ended)
    seen = []
    monkeypatch.setattr("lgrasp_cli.many.print_report", lambda data, *_: seen.append(data))
    objects = ("--object", "tiny", "--object", "sphere")
    cli("generate", *objects, "-p", quick, "-n", 4, "--device", "cpu")
    first, last = ([(job["status"], job["exit_code"]) for job in data["jobs"]] for data in seen)
    assert first == [("done", 0), ("interrupted", 130)]
    assert last == [("done", 0), ("done", 0)]
    assert [data["exit_code"] for data in seen] == [130, 0]


def test_what_holds_nothing(cli, tmp_path):
    (tmp_path / "empty").mkdir()
    for name in ("empty", "*.obj"):
        assert f"object '{name}' holds no mesh; accepted: .obj" in cli("generate", "--object", name).error()
    line = cli("generate", "--object", "tiny", "--hand", "empty").error()
    assert "hand 'empty' holds no hand; folders with hand.yaml and URDF files are accepted" in line


def test_a_word_too_many(cli):
    line = cli("generate", "--object", "mug", "bowl").error()
    assert line.endswith("(bowl); --object takes one value, and may be repeated: --object mug --object bowl")
    line = cli("generate", "--object", "mug", "-n", 10, 20).error()
    assert line.endswith("(20); -n takes one value")
