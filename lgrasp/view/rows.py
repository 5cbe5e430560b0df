"""Rows of shards in a viewer: one after another or side by side, from pregrasp to squeeze, with their contacts."""

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from lgrasp.dataset.scenes import SceneRows
from lgrasp.errors import ConfigError, LgraspError
from lgrasp.notices import notice
from lgrasp.view.figure import GraspFigure, Marks, stage_marks
from lgrasp.view.front import row_link
from lgrasp.view.page import Aim, add_saving
from lgrasp.view.server import View

if TYPE_CHECKING:
    import viser

    from lgrasp.picture.scene import GraspScene

_MOST = 9  # side by side
_APART = 1.1  # times what a row takes on the screen
_SPEED = 0.8  # stages a second
_PAUSE = 1.0  # stages, at the end
_AS_STORED = "as stored"
_READ = 10.0  # [s] that a message stays


class RowsView(View):
    """The rows of shards.

    Args:
        told: the shards as they were named on the command line.
        where: conditions, separated by commas, such as ``metrics/epsilon > 0.05``.
        row: the first that is shown, counted through all shards.

    Raises:
        LgraspError: no such row, a condition that cannot be read or that no row meets, a damaged shard.
    """

    def __init__(self, server: "viser.ViserServer", rows: SceneRows, told: str, where: str = "", row: int = 0) -> None:
        self._server, self._rows, self._told = server, rows, told
        self._lock = threading.RLock()
        self.order: Sequence[int] | np.ndarray = range(len(rows))
        """Rows that can be gone through."""
        self._figures: list[GraspFigure] = []
        self.shown: Sequence[int] = ()
        """Rows on the screen."""
        self.told = ""
        """What is said of the first of them, Markdown."""
        self._met = ""  # conditions that hold for all of order
        self._clock: float | None = None
        rows.place(row)
        first = rows.scene(row)
        links = _links(first)
        self._apart = np.zeros(2)  # [m] right and down
        self._aim = Aim(links, [placed.placed for placed in first.objects], first.contacts.points)
        gui = server.gui
        self._at = gui.add_slider("grasp", 0, max(len(rows) - 1, 1), 1, row)
        self._step = gui.add_button_group("", ("previous", "next"))
        self._time = self._add_time(first.duration)
        self._play = gui.add_checkbox("play", False)
        self._text = gui.add_markdown("")
        with gui.add_folder("choose"):
            self._where = gui.add_text("where", where, hint="such as metrics/epsilon > 0.05, physics/fc_holds")
            apply = gui.add_button("apply")
            metrics = [name for name in rows.columns() if name != "candidate"]
            self._sort = gui.add_dropdown("sort by", (_AS_STORED, *metrics), initial_value=_AS_STORED)
            self._falling = gui.add_checkbox("largest first", True)
            self._side = gui.add_slider("side by side", 1, _MOST, 1, 1)
        with gui.add_folder("show"):
            self._marks = [gui.add_checkbox(name.replace("_", " "), on) for name, on in Marks()._asdict().items()]
        add_saving(server, self, "grasps")
        self._at.on_update(self._guarded(self._show))
        self._side.on_update(self._guarded(self._show))
        for box in self._marks:
            box.on_update(self._guarded(self._mark))
        apply.on_click(self._guarded(self._apply))
        for control in (self._sort, self._falling):
            control.on_update(self._guarded(lambda: self._choose(self._met)))
        self._step.on_click(self._guarded(lambda: self._go(1 if self._step.value == "next" else -1)))
        if where:
            self._choose(where)
            nearest = int(np.argmin(np.abs(np.asarray(self.order) - row)))
            if row and self.order[nearest] != row:
                notice(f"row {row:,} does not satisfy the conditions; row {self.order[nearest]:,} is shown")
            self._at.value = nearest
        self._show()

    def tick(self, seconds: float) -> None:
        """Go on with the animation, if it runs."""
        with self._lock:
            if self._play.value:
                end = self._time.max + _PAUSE
                self._clock = (self._clock + _SPEED * seconds) % end if self._clock is not None else 0.0
                self._time.value = min(self._clock, self._time.max)
            else:
                self._clock = None

    def go(self, row: int) -> None:
        """Show a row, counted through all shards; of all rows, if it does not meet the conditions."""
        self._rows.place(row)
        with self._lock:
            if row not in self.order:
                self._where.value = ""
                self._choose("")
            position = int(np.flatnonzero(np.asarray(self.order) == row)[0])
            self.show(position, int(self._side.value))
            self._at.value = position

    def meshes(self) -> trimesh.Scene:
        """Hands and objects as they are shown."""
        scene = trimesh.Scene()
        with self._lock:
            for figure in self._figures:
                T = np.eye(4)
                T[:3, 3] = figure.frame.position
                for name, mesh in figure.meshes().items():
                    scene.add_geometry(mesh, f"{figure.name}/{name}", f"{figure.name}/{name}", transform=T)
        return scene

    def _guarded(self, action: Callable[[], None]) -> Callable[["viser.GuiEvent"], None]:
        """A callback of a control: one at a time; what goes wrong is told in the browser."""

        def call(event: "viser.GuiEvent") -> None:
            with self._lock:
                try:
                    action()
                except LgraspError as error:
                    for client in self._server.get_clients().values():
                        client.add_notification("this does not work", str(error), color="red", auto_close_seconds=_READ)

        return call

    def _go(self, step: int) -> None:
        self._at.value = int(np.clip(self._at.value + step, 0, len(self.order) - 1))

    def choose(self, where: str, sort: str = _AS_STORED, *, falling: bool = True, side: int = 1) -> None:
        """Show the first of the rows that satisfy conditions.

        Args:
            where: conditions, separated by commas.
            sort: a column, or ``as stored``.
            falling: the largest first.
            side: rows side by side.

        Raises:
            LgraspError: a condition that cannot be read, no such column, no such row; all stays as it is.
        """
        order = self._rows.meeting(where)
        if sort != _AS_STORED:
            values = self._rows.column(sort)[np.asarray(order)]
            order = np.asarray(order)[np.argsort(-values if falling else values, kind="stable")]
        with self._lock:
            self.order, self._met = order, where
            self._at.max = max(len(order) - 1, 1)
            self._at.value = 0
            self.show(0, side)

    def show(self, position: int, side: int = 1) -> None:
        """Read and show rows side by side, from a position in :attr:`order` on.

        Raises:
            ShardError: a shard is damaged.
        """
        with self._lock, self._server.atomic():
            first = int(np.clip(position, 0, len(self.order) - 1))
            chosen = [int(row) for row in self.order[first : first + max(side, 1)]]
            scenes = [self._rows.scene(row) for row in chosen]
            while len(self._figures) > len(chosen):
                self._server.scene.remove_by_name(self._figures.pop().name)
            while len(self._figures) < len(chosen):
                self._figures.append(GraspFigure(self._server.scene, f"/grasp{len(self._figures)}"))
            columns = int(np.ceil(np.sqrt(len(chosen))))
            nearer, self._apart = self._apart, np.max([self._apart, *self._spans(scenes)], axis=0)
            right, down = self._apart[0] * self._aim.right, self._apart[1] * self._aim.down
            places = [i % columns * right + i // columns * down for i in range(len(chosen))]
            for figure, scene, place in zip(self._figures, scenes, places, strict=True):
                figure.show(scene)
                figure.frame.position = place
            if len(chosen) != len(self.shown) or (len(chosen) > 1 and (nearer != self._apart).any()):
                self._aim.apply(self._server, (places[0] + places[-1]) / 2, columns * (1 if columns == 1 else 1.2))
            duration = max(scene.duration for scene in scenes)
            if duration != self._time.max:
                before, self._time = self._time, self._add_time(duration, self._time.order)
                before.remove()
            self.shown, self.told = chosen, self._described(chosen)
            self._text.content = self.told
            self.move(self._time.value)
            self._mark()

    def move(self, time: float) -> None:
        """Show the grasps at a time, see :meth:`GraspScene.at`."""
        with self._lock, self._server.atomic():
            for figure in self._figures:
                figure.move(time)

    def _add_time(self, duration: float, order: float | None = None) -> "viser.GuiSliderHandle[float]":
        """A slider of the stages, at the last grasp."""
        slider = self._server.gui.add_slider(
            "stage", 0.0, duration, 0.01, duration - 1, marks=stage_marks(duration), order=order
        )
        slider.on_update(self._guarded(lambda: self.move(self._time.value)))
        return slider

    def _choose(self, where: str) -> None:
        self.choose(where, self._sort.value, falling=self._falling.value, side=int(self._side.value))

    def _apply(self) -> None:
        try:
            self._choose(self._where.value)
        except LgraspError as error:
            raise ConfigError(f"{error}; still shown: {self._met or 'all rows'}") from None

    def _show(self) -> None:
        for slider in (self._at, self._side):  # what is typed may be outside
            inside = int(np.clip(slider.value, slider.min, slider.max))
            if slider.value != inside:
                slider.value = inside
        self.show(int(self._at.value), int(self._side.value))

    def _spans(self, scenes: Sequence["GraspScene"]) -> list[np.ndarray]:
        """What each of several rows takes on the screen [m], with some room: right and down."""
        if len(scenes) == 1:
            return []
        return [_APART * self._aim.spans([*_links(s), *(placed.placed for placed in s.objects)]) for s in scenes]

    def _mark(self) -> None:
        marks = Marks(*(box.value for box in self._marks))
        for figure, row in zip(self._figures, self.shown, strict=True):
            figure.mark(marks, self._rows.friction(row))

    def _described(self, chosen: Sequence[int]) -> str:
        path, number = self._rows.place(chosen[0])
        lines = [f"**{self._rows.caption(chosen[0], [0, len(self._rows) - 1])}**, {number:,} of `{path.name}`", ""]
        if len(chosen) > 1:
            lines += [f"shown: rows {', '.join(f'{row:,}' for row in chosen)}", ""]
        lines += ["| | |", "|---|---|"]
        for name, value in self._rows.numbers(chosen[0]).items():
            told = f"{value:.4g}" if isinstance(value, float) else str(value)
            lines.append(f"| {name.partition('/')[2]} | {told} |")
        return "\n".join([*lines, "", f"{row_link(chosen[0])}, `lgrasp view {self._told} --row {chosen[0]}`"])


def _links(scene: "GraspScene") -> list[trimesh.Trimesh]:
    """Of the hand at the last grasp."""
    return list(scene.hand.placed(scene.at(scene.duration - 1)[0]).values())
