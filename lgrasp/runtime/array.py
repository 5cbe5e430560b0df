"""Which parts of a job each task of a job array makes."""

import os
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

from lgrasp.errors import ConfigError

_SHOWN = 5  # numbers of parts

SUBMITTED = "LGRASP_ARRAY"
"""Variable of the environment with the array that a script was submitted as at first."""

Part = TypeVar("Part")


class SlurmArray(NamedTuple):
    """A task of a job array, and the array, as SLURM describes them.

    Of a list such as 17,23 SLURM tells the first, the last and how many there are; the step is 1.
    """

    task: int
    first: int
    last: int
    step: int
    count: int

    @property
    def whole(self) -> bool:
        """True for a range without gaps, so that a task knows how many are before it."""
        return self.step > 0 and self.count == (self.last - self.first) // self.step + 1

    @property
    def text(self) -> str:
        """The array as sbatch takes it."""
        return f"{self.first}-{self.last}" + (f":{self.step}" if self.step != 1 else "")

    def is_part_of(self, text: str) -> "SlurmArray | None":
        """This task in an array that :attr:`text` describes, if this array submits some of its tasks again.

        Several tasks from the first one on, without a gap, are an array of their own.
        """
        match = re.fullmatch(r"(\d+)-(\d+)(?::(\d+))?", text)
        if not match:
            return None
        first, last, step = int(match[1]), int(match[2]), int(match[3] or 1)
        tasks = range(first, last + 1, max(step, 1))
        smaller = self.whole and self.count > 1 and (self.first, self.step) == (first, step)
        if smaller or self.count >= len(tasks) or not {self.task, self.first, self.last} <= set(tasks):
            return None
        return SlurmArray(self.task, first, last, step, len(tasks))


class Array(NamedTuple):
    """How tasks share parts: those of a job are dealt out one after another, or those of several jobs."""

    task: int = 0
    tasks: int = 1
    slurm: SlurmArray | None = None
    """Where the two numbers come from, once :meth:`resolved`."""
    before: int = 0
    """Parts of the jobs before, if there are several."""
    total: int = 0
    """Parts of all the jobs, if there are several."""
    begun: str = ""
    """The array of which these tasks are submitted again."""
    submitted: str = ""
    """The array that the script of this task was submitted as at first, as :attr:`SlurmArray.text`."""
    lane: int = 0
    """Number of the device, of :attr:`lanes` that share the parts of the task."""
    lanes: int = 1

    def resolved(self, begun: str = "") -> "Array":
        """With the numbers of the task and of the tasks.

        Args:
            begun: the array that began the job's run, as :attr:`SlurmArray.text`; "" if none did, or it is not known.

        Raises:
            ConfigError: numbers out of range, or a list of tasks that are not of an array that is known.
        """
        if self.slurm is None:
            if not 0 <= self.task < self.tasks:
                raise ConfigError(f"--array {self.task}/{self.tasks}: need 0 <= task < number of tasks")
            return self
        again = self.slurm.is_part_of(begun) or self.slurm.is_part_of(self.submitted)
        if not again and not self.slurm.whole:
            raise ConfigError(
                f"array task {self.slurm.task}: {self.slurm.count} tasks from {self.slurm.first} to {self.slurm.last} "
                f"are a part of an array, of which this folder knows nothing; say how many tasks the whole has with "
                f"--array {self.slurm.task}/N, or --array off if every task has a job of its own"
            )
        found = again or self.slurm
        task = (found.task - found.first) // found.step
        return self._replace(task=task, tasks=found.count, begun=again.text if again else "")

    def share(self, parts: Sequence[Part], what: str = "part") -> list[Part]:
        """Those of a job's parts that the task makes, in its lane.

        Raises:
            ConfigError: SLURM started more tasks than there are parts.
        """
        self.check_busy(len(parts), what)
        own = range((self.task - self.before) % self.tasks, len(parts), self.tasks)
        return [parts[i] for i in own if (self.before + i) // self.tasks % self.lanes == self.lane]

    def check_early(self, number: int | None, what: str) -> None:
        """As :meth:`share`, of the parts of one job (None: not known yet), as far as can be told before the job is
        loaded."""
        if number is not None and self.slurm and self.slurm.whole:
            self.resolved().check_busy(number, what)

    def check_busy(self, number: int, what: str) -> None:
        """Refuse an array of SLURM in which a task has nothing to do.

        Args:
            number: parts of the job.

        Raises:
            ConfigError: there are fewer parts than tasks.
        """
        number = self.total or number
        if self.slurm and number < self.tasks:
            raise ConfigError(
                f"array task {self.task} of {self.tasks}: there {'is' if number == 1 else 'are'} {number} {what}"
                f"{'' if number == 1 else 's'} to share; give --array off if every task has a job of its own, or "
                f"--array {self.task}/{self.tasks} if tasks may have nothing to do"
            )

    @property
    def text(self) -> str:
        """The array of SLURM that shares parts anew, as :attr:`SlurmArray.text`; "" if there is none."""
        return self.slurm.text if self.slurm and not self.begun else ""

    def words(self, own: Sequence[int], what: str) -> str:
        """What the task makes, by numbers of parts, in one line."""
        numbers = ", ".join(map(str, own[:_SHOWN])) + (", ..." if len(own) > _SHOWN else "")
        again = f" (of array {self.begun}, which began the run)" if self.begun else ""
        parts = f"{what}{'' if len(own) == 1 else 's'} {numbers}" if own else f"no {what}"
        return f"array task {self.task} of {self.tasks}{again}: {parts}"


def parse_array(text: str, environment: Mapping[str, str] | None = None) -> Array:
    """The array that ``--array`` names: ``I/N``, ``off``, or ``auto`` for that of SLURM, if it started this process.

    Raises:
        ConfigError: none of these, or a SLURM variable that is no integer.
    """
    if text == "auto":
        return _slurm(os.environ if environment is None else environment)
    if text == "off":
        return Array()
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not match:
        raise ConfigError(f"--array '{text}': accepted are auto, off, and I/N for task I of N, counted from 0")
    return Array(int(match[1]), int(match[2])).resolved()


def _slurm(environment: Mapping[str, str]) -> Array:
    if "SLURM_ARRAY_TASK_ID" not in environment:
        return Array()
    names = [f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "MIN", "MAX", "STEP", "COUNT")]
    try:
        return Array(
            slurm=SlurmArray(*(int(environment[name]) for name in names)), submitted=environment.get(SUBMITTED, "")
        )
    except KeyError as error:
        raise ConfigError(f"{error.args[0]} is not set; give --array I/N or --array off") from None
    except ValueError:
        told = ", ".join(f"{name}={environment[name]}" for name in names if name in environment)
        raise ConfigError(f"{told}: whole numbers are accepted; give --array I/N or --array off") from None
