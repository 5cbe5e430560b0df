"""``lgrasp learn``: a predictor is trained, kept, measured; one line for bad input."""

import json
from pathlib import Path


def test_fit_and_eval(generate, cli):
    assert generate().code == 0
    options = ["--steps", 10, "--joint-steps", 2, "--unrolled", 1, "--batch", 8, "--device", "cpu"]
    done = cli("learn", "fit", "out", "--out", "net.pt", *options, "--json", "fit.json")
    assert done.code == 0, done
    assert "jointly through the refiner" in done.out
    data = json.loads(Path("fit.json").read_text())
    assert data["objects"] == ["tiny"]
    assert data["frozen"]["poses"] == data["joint"]["poses"] > 0
    told = cli("learn", "eval", "net.pt", "out", "--clouds", 1, "--device", "cpu", "--json", "-")
    found = json.loads(told.out)
    assert found["outer"] == [3, 6, 10, 13]
    assert len(found["refined"]) == 4
    assert found["refined"][-1] < found["coarse"]
    Path("bad.pt").write_bytes(b"nonsense")
    assert "not a predictor" in cli("learn", "eval", "bad.pt", "out").error()
    assert "no such file" in cli("learn", "eval", "absent.pt", "out").error()


def test_bad_input(cli):
    assert "no such file or folder" in cli("learn", "fit", "absent").error()
    assert "key 'batch' = 0" in cli("learn", "fit", "absent", "--batch", 0).error()
