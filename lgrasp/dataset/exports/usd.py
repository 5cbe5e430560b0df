"""USD: one stage per object, the hand around it, a time sample for each grasp."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from trimesh import Trimesh

from lgrasp.dataset.exports.folder import GRASPS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.mjcf import Cut
from lgrasp.dataset.exports.reading import WRONG, GraspSet, numbers, open_folder
from lgrasp.dataset.exports.selection import ExportObject, Selection
from lgrasp.dataset.files import parsing
from lgrasp.errors import ConfigError, ShardError
from lgrasp.files import temporary_folder, write_file
from lgrasp.geometry.poses import inverse, pose_from_matrix, pose_matrix
from lgrasp.paths import free_name
from lgrasp.picture.scene import HandShape
from lgrasp.runtime.optional import import_optional

_POSTURES = ("grasp", "pregrasp", "squeeze")
_HAND = "/World/hand"
_POINT = 0.002  # [m] of a point cloud

USD_NOTES = """\
grasps/CODE.usdc   USD stage of all grasps of one object: metres, z up. Time code t is the t-th grasp; in
                   between there is none.

  /World/CODE      the object's mesh, at the origin, not turned
  /World/hand/*    the links that have a surface: their transform in the object's frame is a time sample, the mesh is
                   below them. Variant set 'posture' of /World/hand: grasp (shown first), pregrasp, squeeze.
  attributes       of /World/hand, additions of lgrasp: lgrasp:jointNames; time samples lgrasp:root (transform of link
                   {root} in the object's frame), lgrasp:holds, and of each posture lgrasp:POSTURE (joints [rad or m])
{table}"""


def import_pxr() -> Any:
    """The packages of OpenUSD.

    Raises:
        ConfigError: they are not installed.
    """
    modules = ("pxr", "Gf", "Sdf", "Tf", "Usd", "UsdGeom")
    return import_optional("format usd needs usd-core", '"lgrasp[usd]"', *modules, error=ConfigError)


class UsdWriter:
    """Writes ``grasps/CODE.usdc`` for every object.

    Raises:
        ConfigError: usd-core is not installed.
        HandError, ShardError: the hand cannot be used.
    """

    def __init__(self, selection: Selection, frames: HandFrames, cut: Cut | None = None) -> None:
        self._pxr = import_pxr()
        self._selection, self._frames = selection, frames
        self._shape = HandShape.of_record(selection.hand)

    def __call__(self, out: Path, advance: Callable[[int], None]) -> None:
        """Write into the folder of an export, calling ``advance`` with numbers of rows that are done."""
        for place, item in enumerate(self._selection.objects):
            stage = self._stage(place, item, advance)
            with temporary_folder() as folder:
                made = folder / "stage.usdc"
                stage.GetRootLayer().Export(str(made))
                write_file(out / GRASPS / f"{item.code}.usdc", made.read_bytes())

    def _stage(self, place: int, item: ExportObject, advance: Callable[[int], None]) -> Any:
        usd, geom, types = self._pxr.Usd, self._pxr.UsdGeom, self._pxr.Sdf.ValueTypeNames
        stage = usd.Stage.CreateInMemory()
        geom.SetStageMetersPerUnit(stage, 1.0)
        geom.SetStageUpAxis(stage, geom.Tokens.z)
        stage.SetDefaultPrim(geom.Xform.Define(stage, "/World").GetPrim())
        record = item.mesh()
        name = free_name(self._pxr.Tf.MakeValidIdentifier(item.code), "", ["hand"])
        if len(record.faces):
            self._mesh(stage, f"/World/{name}", Trimesh(record.vertices, record.faces, process=False))
        else:
            points = geom.Points.Define(stage, f"/World/{name}")
            points.CreatePointsAttr(np.asarray(record.vertices, np.float32))
            points.CreateWidthsAttr(np.full(len(record.vertices), _POINT, np.float32))
        hand = geom.Xform.Define(stage, _HAND).GetPrim()
        variants = hand.GetVariantSets().AddVariantSet("posture")
        for posture in _POSTURES:
            variants.AddVariant(posture)
        ops: dict[str, Any] = {}
        taken: list[str] = []
        for link, mesh in self._shape.links.items():
            taken.append(free_name(self._pxr.Tf.MakeValidIdentifier(link), "", taken))
            path = f"{_HAND}/{taken[-1]}"
            ops[link] = geom.Xform.Define(stage, path).AddTransformOp()
            self._mesh(stage, f"{path}/mesh", mesh)
        hand.CreateAttribute("lgrasp:jointNames", types.StringArray).Set(list(self._frames.joint_names))
        told = {posture: hand.CreateAttribute(f"lgrasp:{posture}", types.DoubleArray) for posture in _POSTURES}
        root = hand.CreateAttribute("lgrasp:root", types.Matrix4d)
        holds = hand.CreateAttribute("lgrasp:holds", types.Bool)
        names = ("table_plane", "table_approach") if self._selection.on_table else ()
        tables = {name: hand.CreateAttribute(f"lgrasp:{name}", types.DoubleArray) for name in names}
        time = 0
        for batch in self._selection.batches(place, advance):
            T_object_base = pose_matrix(inverse(batch.object_pose[:, 0]))
            T_object_root = pose_matrix(self._frames.root_in_object(batch.object_pose[:, 0], batch.q))
            times = range(time, time + len(batch.q))
            for posture, q in zip(_POSTURES, batch.postures, strict=True):
                variants.SetVariantSelection(posture)
                with variants.GetVariantEditContext():
                    for link, T_base_link in self._shape.poses(q).items():
                        self._sample(ops[link], times, T_object_base @ T_base_link)
                for t, values in zip(times, q.tolist(), strict=True):
                    told[posture].Set(values, t)
            self._sample(root, times, T_object_root)
            for t, held in zip(times, batch.holds > 0, strict=True):
                holds.Set(bool(held), t)
            for name, attribute in tables.items():
                for t, values in zip(times, batch.table[name].tolist(), strict=True):
                    attribute.Set(values, t)
            time = times.stop
        variants.SetVariantSelection(_POSTURES[0])
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(time - 1)
        return stage

    def _sample(self, attribute: Any, times: range, transforms: np.ndarray) -> None:
        """Time samples of transforms, (n, 4, 4); USD writes vectors as rows."""
        for t, values in zip(times, transforms.mT.tolist(), strict=True):
            attribute.Set(self._pxr.Gf.Matrix4d(values), t)

    def _mesh(self, stage: Any, path: str, mesh: Trimesh) -> None:
        made = self._pxr.UsdGeom.Mesh.Define(stage, path)
        made.CreatePointsAttr(np.asarray(mesh.vertices, np.float32))
        made.CreateFaceVertexCountsAttr(np.full(len(mesh.faces), 3, np.int32))
        made.CreateFaceVertexIndicesAttr(np.asarray(mesh.faces, np.int32).ravel())
        made.CreateSubdivisionSchemeAttr(self._pxr.UsdGeom.Tokens.none)
        if len(mesh.vertices):
            made.CreateExtentAttr(np.stack([mesh.vertices.min(0), mesh.vertices.max(0)]).astype(np.float32))


def read_usd(path: Path | str, *, joint_names: Sequence[str] | None = None) -> GraspSet:
    """Read an export of lgrasp, or stages of one; arguments and errors as of
    :func:`~lgrasp.dataset.exports.formats.read_grasps`."""
    usd = import_pxr().Usd
    folder = open_folder(path, ".usdc", "usd", joint_names)
    for file in folder.files:
        with parsing(file, "a stage of USD", (RuntimeError, *WRONG)):
            stage = usd.Stage.Open(str(file))
            hand = stage.GetPrimAtPath(_HAND)
            names = hand.GetAttribute("lgrasp:jointNames").Get() if hand else None
            if not names:
                raise ShardError(f"{file}: names no joints ({_HAND}, lgrasp:jointNames); stages of lgrasp are read")
            root = hand.GetAttribute("lgrasp:root")
            times = root.GetTimeSamples()
            q = [[hand.GetAttribute(f"lgrasp:{name}").Get(t) for name in _POSTURES] for t in times]
            T = numbers([root.Get(t) for t in times], "lgrasp:root", -1, 4, 4)
            folder.add(file, names, q, pose_from_matrix(T.mT), file.stem)
    return folder.grasps()
