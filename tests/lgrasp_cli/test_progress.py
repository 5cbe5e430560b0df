"""Progress and tables on a terminal of 80 columns."""

import io
import re
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest

from lgrasp.engine.events import Part
from lgrasp_cli import progress
from lgrasp_cli.progress import Bar, JobProgress
from lgrasp_cli.tables import TextTable, print_report


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock(monkeypatch):
    """clock(*seconds): what the clock will say."""

    def clock(*seconds):
        monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=iter(seconds).__next__))

    return clock


@pytest.fixture
def terminal(monkeypatch):
    """terminal(): standard error becomes a terminal of 80 columns."""

    def terminal():
        for name, value in {"COLUMNS": "80", "TERM": "xterm"}.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(sys, "stderr", Terminal())
        return sys.stderr

    return terminal


def lines(terminal) -> list[str]:
    return [line for line in re.split(r"[\r\n]+", re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", terminal.getvalue())) if line]


def test_nothing_but_the_bar_is_cut(terminal, clock):
    clock(0, 0, 5, 15)
    screen = terminal()
    with Bar() as bar:
        for done in (1_000_000, 1_000_100, 1_010_100):
            bar.show("sequences", done, 2_000_000, "612,345 hold")
    found = lines(screen)
    assert max(map(len, found)) <= 80
    assert re.search(r"^sequences .*1,010,100/2,000,000 .* 0:16:30 left  1,000/s  612,345 hold$", found[-1])


def test_the_clock_goes_on_when_something_is_full(terminal):
    screen = terminal()
    with Bar() as bar:
        bar.share("index", 1.0)
        bar._bar.tasks[0]._get_time, bar._bar.tasks[0].start_time = lambda: 75.0, 0.0
        bar.show("grasps", 1, 10)
    assert re.search(r" 1/10 0:01:15", lines(screen)[-1])


def test_work_on_rows_to_come_counts(terminal, clock):
    """A round of sequences takes long and gives all of them at its end."""
    clock(0, 0, 5, 35)
    screen = terminal()
    with Bar() as bar:
        for ahead in (0, 1, 25):
            bar.show("sequences", 0, 100, ahead=ahead)
    assert re.search(r"0/100 .* 0:01:34 left  0.8/s", lines(screen)[-1])


def test_preparation_and_rows_of_an_earlier_run_are_no_speed(clock):
    """Of 2,000 rows 900 are there, 100 of them in a file that is complete; the object is cut for 100 s."""
    clock(0, 0, 100, 110, 120)
    shown = []
    bar = Bar(quiet=True)
    bar._tell = lambda what, count, share, tail: shown.append((count, tail))
    whole, begun, other = (Part(number, Path(), rows) for number, rows in enumerate((100, 1000, 900)))
    told = JobProgress(bar, "grasps")
    told.started([whole, begun, other], {0: 100})
    told.advanced(begun, 801, kept=800)
    told.advanced(begun, 811, kept=800)
    told.advanced(other, 510, kept=500)  # begun by the same run, made beside it
    assert shown == [
        ("100/2,000", ""),
        ("901/2,000", ""),
        ("911/2,000", "0:18:09 left  1.0/s"),
        ("1,421/2,000", "0:09:39 left  1.0/s"),
    ]


def test_parts_made_side_by_side_tell_one_after_another():
    class Slow(Bar):
        """Asserts that nobody else shows something meanwhile."""

        shows = shown = 0

        def show(self, *told, **more):
            self.shows += 1
            time.sleep(0.002)
            assert self.shows == 1
            self.shows -= 1
            self.shown += 1

    bar = Slow(quiet=True)
    told = JobProgress(bar, "rows")
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda n: told.advanced(Part(n, Path(), 10), 5), range(20)))
    assert bar.shown == 20


def test_lines_where_there_is_no_terminal(clock, capsys):
    clock(0, 0, 5, 6, 6, 17, 17, 17)
    with Bar() as bar:
        for done in (0, 1, 11):
            bar.show("rows", done, 100, "7 hold")
    assert capsys.readouterr().err == "rows  11/100  0:01:38 left  0.9/s  7 hold\n"


def test_tables_fit(monkeypatch):
    table = TextTable(("part", "value", "meaning"), [("search", "1" * 300, "what it is " * 9)], right=("value",))
    for screen, widest in ((Terminal(), 80), (io.StringIO(), 500)):
        monkeypatch.setenv("COLUMNS", "80")
        monkeypatch.setattr(sys, "stdout", screen)
        print_report({}, None, [table])
        text = screen.getvalue()
        assert max(map(len, text.splitlines())) <= widest
        assert (text.count("1"), text.count("what")) == (300, 9)
    assert len(text.splitlines()) == 2  # a file is not made narrower
