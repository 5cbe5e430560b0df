"""MJCF, MuJoCo's own format -> a URDF with the same bodies, joints, couplings and geometry, and its meshes."""

import re
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from lxml import etree
from scipy.spatial.transform import Rotation

from lgrasp.errors import HandError, short_reason
from lgrasp.hand.drafting.elements import number_text, set_origin
from lgrasp.hand.drafting.mjcf_couplings import Follows, couplings, tendon_terms
from lgrasp.hand.urdf import find_mesh
from lgrasp.runtime.optional import import_mujoco
from lgrasp.words import plural

_SIDES = 32  # of a capsule


def mjcf_to_urdf(
    path: Path, folder: Path, *, root: str | None = None, mesh_dirs: Sequence[Path] = ()
) -> tuple[Path, list[str]]:
    """Write an MJCF as ``folder/hand.urdf`` with its meshes beside it; links have the frames of the bodies.

    Args:
        root: the hand is what is below this body.
        mesh_dirs: folders in which meshes are looked for as well, see :func:`lgrasp.hand.urdf.find_mesh`.

    Returns:
        The URDF, and a line for everything that it cannot say.

    Raises:
        HandError: MuJoCo cannot read the file, or the hand has a ball joint, a loop or a coupling that is not linear.
        PhysicsError: MuJoCo is not installed.
    """
    model = _compiled(path, mesh_dirs)
    try:
        writer = _Writer(model, folder, root)
        robot = writer.robot()
    except HandError as error:
        raise HandError(f"MJCF {path}: {error}") from None
    urdf = folder / "hand.urdf"
    urdf.write_bytes(etree.tostring(robot, xml_declaration=True, encoding="utf-8"))
    return urdf, writer.notes


def _compiled(path: Path, mesh_dirs: Sequence[Path]) -> Any:
    """The compiled model, without what is not needed of it."""
    mujoco = import_mujoco("a hand in MJCF")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        for geom in [geom for geom in spec.geoms if geom.type == mujoco.mjtGeom.mjGEOM_HFIELD]:
            spec.delete(geom)
        for material in spec.materials:
            material.textures = [""] * len(material.textures)
        for part in (*spec.keys, *spec.skins, *spec.flexes, *spec.textures, *spec.hfields):
            spec.delete(part)
        for mesh in spec.meshes:
            if mesh.file:
                name = Path(mesh.file).name if spec.strippath else mesh.file
                mesh.file = str(find_mesh(path, mesh.name or name, str(Path(spec.meshdir) / name), mesh_dirs))
        spec.meshdir, spec.strippath = "", False
        spec.compiler.fusestatic = spec.compiler.discardvisual = False
        return spec.compile()
    except ValueError as error:
        raise HandError(f"MJCF {path}: MuJoCo cannot read it: {short_reason(error, 300)}") from None


class _Writer:
    """Writes the URDF of a compiled model; bodies, joints and geoms are called by their numbers."""

    def __init__(self, model: Any, folder: Path, root: str | None) -> None:
        import mujoco

        self.notes: list[str] = []
        self._m, self._lib, self._folder = model, mujoco, folder
        self._sliding, hinge = int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)
        self._moving = [j for j in range(model.njnt) if model.jnt_type[j] in (self._sliding, hinge)]
        if not self._moving:
            raise HandError("it has no hinge or slide joint; a hand needs some")
        self._root = self._top(root)
        self._bodies = self._below(self._root)
        self._joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in self._bodies[1:]]
        self._driven, self._pulled = self._drives()
        self._follows = couplings(model, self._joints, self._bodies, self._driven)
        self._names: set[str] = set()
        self._files: dict[tuple[str, int], str] = {}

    def _top(self, root: str | None) -> int:
        """The body that is the root link: ``root``, the one on the world that carries all joints, or the world.

        Where nothing moves below ``root``, the file is taken whole: who cuts it can then name other links."""
        m = self._m
        if root is not None and (found := [b for b in range(m.nbody) if self._name("body", b) == root]):
            below = self._below(found[0])[1:]
            if any(m.jnt_bodyid[j] in below for j in self._moving):
                return found[0]
        tops = {int(m.body_rootid[m.jnt_bodyid[j]]) for j in self._moving}
        alone = len(tops) == 1 and not any(m.jnt_bodyid[j] in tops for j in self._moving)
        return tops.pop() if alone else 0

    def _below(self, root: int) -> list[int]:
        """A body and all below it, parents first; of the world without objects that nothing of theirs moves."""
        m = self._m
        moved = {int(m.body_rootid[m.jnt_bodyid[j]]) for j in self._moving}
        found = [root]
        for b in range(root + 1, m.nbody):
            top = m.body_parentid[b] == 0
            object_ = top and b not in moved and m.body_jntnum[b]
            if m.body_parentid[b] in found and not object_:
                found.append(b)
        return found

    def _drives(self) -> tuple[set[int], list[dict[int, float]]]:
        """Joints of the hand that have an actuator, and the terms of tendons that have one."""
        m, driven, pulled = self._m, set(), []
        for i in range(m.nu):
            target = int(m.actuator_trnid[i, 0])
            if self._drives_joint(i) and target in self._joints:
                driven.add(target)
            elif m.actuator_trntype[i] == int(self._lib.mjtTrn.mjTRN_TENDON) and (terms := tendon_terms(m, target)):
                pulled.append({j: c for j, c in terms.items() if j in self._joints})
        return driven, pulled

    def _drives_joint(self, actuator: int) -> bool:
        kinds = self._lib.mjtTrn
        return self._m.actuator_trntype[actuator] in (int(kinds.mjTRN_JOINT), int(kinds.mjTRN_JOINTINPARENT))

    def _name(self, kind: str, number: int) -> str:
        return getattr(self._m, kind)(number).name or f"{kind}_{number}"

    def _new(self, name: str) -> str:
        """A name that no link or joint has yet."""
        while name in self._names:
            name += "_"
        self._names.add(name)
        return name

    def robot(self) -> etree._Element:
        """The <robot> element; meshes are written."""
        name = self._m.names.split(b"\0", 1)[0].decode("utf-8", "replace")
        robot = etree.Element("robot", name=re.sub(r"\W+", "_", name) or "hand")
        self._names = {self._name("body", b) for b in self._bodies} | {self._name("joint", j) for j in self._joints}
        for b in self._bodies:
            link = etree.SubElement(robot, "link", name=self._name("body", b))
            self._add_inertia(link, b)
            for g in range(self._m.body_geomadr[b], self._m.body_geomadr[b] + self._m.body_geomnum[b]):
                self._add_geom(link, g)
        for b in self._bodies[1:]:
            self._add_joints(robot, b)
        self._note_drives()
        self._note_passing()
        return robot

    def _add_inertia(self, link: etree._Element, b: int) -> None:
        if self._m.body_mass[b] <= 0:
            return
        inertial = etree.SubElement(link, "inertial")
        set_origin(inertial, self._m.body_ipos[b], _rotation(self._m.body_iquat[b]))
        etree.SubElement(inertial, "mass", value=number_text([self._m.body_mass[b]]))
        inertia: dict[str, str] = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
        for axis, value in zip("xyz", self._m.body_inertia[b], strict=True):
            inertia[f"i{axis}{axis}"] = number_text([value])
        etree.SubElement(inertial, "inertia", inertia)

    def _add_geom(self, link: etree._Element, g: int) -> None:
        """<collision> of a geom that can touch something, else <visual>."""
        m, kinds = self._m, self._lib.mjtGeom
        kind, size = kinds(m.geom_type[g]), m.geom_size[g]
        paired = g in m.pair_geom1 or g in m.pair_geom2
        touches = bool(m.geom_contype[g] or m.geom_conaffinity[g] or paired)
        if kind == kinds.mjGEOM_PLANE:
            return
        element = etree.SubElement(link, "collision" if touches else "visual")
        set_origin(element, m.geom_pos[g], _rotation(m.geom_quat[g]))
        geometry = etree.SubElement(element, "geometry")
        if kind == kinds.mjGEOM_BOX:
            etree.SubElement(geometry, "box", size=number_text(2 * size))
        elif kind == kinds.mjGEOM_SPHERE:
            etree.SubElement(geometry, "sphere", radius=number_text(size[:1]))
        elif kind == kinds.mjGEOM_CYLINDER:
            etree.SubElement(geometry, "cylinder", radius=number_text(size[:1]), length=number_text(2 * size[1:2]))
        else:
            etree.SubElement(geometry, "mesh", filename=self._mesh_file(g))
        if not touches:
            colour = m.geom_rgba[g] if m.geom_matid[g] < 0 else m.mat_rgba[m.geom_matid[g]]
            material = etree.SubElement(element, "material", name=self._new(f"colour_{g}"))
            etree.SubElement(material, "color", rgba=number_text(colour))

    def _mesh_file(self, g: int) -> str:
        """Name of the file, written now, with the mesh of a geom [m]."""
        m, kinds, size = self._m, self._lib.mjtGeom, self._m.geom_size[g]
        kind, data = kinds(m.geom_type[g]), int(m.geom_dataid[g])
        what = ("mesh", data) if data >= 0 else ("geom", g)
        if what in self._files:
            return self._files[what]
        if kind == kinds.mjGEOM_CAPSULE:
            mesh = trimesh.creation.capsule(2 * size[1], size[0], (_SIDES, _SIDES))
        elif kind == kinds.mjGEOM_ELLIPSOID:
            mesh = trimesh.creation.icosphere(subdivisions=3).apply_scale(size)
        else:
            v, f = m.mesh_vertadr[data], m.mesh_faceadr[data]
            vertices, faces = m.mesh_vert[v : v + m.mesh_vertnum[data]], m.mesh_face[f : f + m.mesh_facenum[data]]
            mesh = trimesh.Trimesh(vertices, faces, process=False)
        file = f"{re.sub(r'[^A-Za-z0-9_-]+', '_', self._name(*what))}.stl"
        while (self._folder / file).exists():
            file = f"_{file}"
        mesh.export(self._folder / file)
        self._files[what] = file
        return file

    def _add_joints(self, robot: etree._Element, b: int) -> None:
        """The joints that move a body on its parent, one after another."""
        m = self._m
        at, xyz, turn = self._name("body", m.body_parentid[b]), m.body_pos[b], _rotation(m.body_quat[b])
        joints = list(range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]))
        for j in joints:
            kind, name = m.jnt_type[j], self._name("joint", j)
            if kind == int(self._lib.mjtJoint.mjJNT_FREE):
                continue
            if kind == int(self._lib.mjtJoint.mjJNT_BALL):
                raise HandError(f"joint '{name}' is a ball joint; hinge and slide joints are accepted")
            axis, anchor = m.jnt_axis[j], m.jnt_pos[j]
            xyz = xyz + turn.apply(anchor)
            # the body is where the file has it at the joint's reference
            step = -float(m.qpos0[m.jnt_qposadr[j]])
            follows = self._follows.get(j)
            if follows and follows.source is None:
                step += follows.offset
            if kind == self._sliding:
                xyz = xyz + turn.apply(step * axis)
            else:
                turn = turn * Rotation.from_rotvec(step * axis)
            last = j == joints[-1] and not anchor.any()
            child = self._name("body", b) if last else self._new(f"{name}_link")
            if not last:
                etree.SubElement(robot, "link", name=child)
            self._add_joint(robot, j, (at, child), (xyz, turn), follows)
            at, xyz, turn = child, -anchor, Rotation.identity()
        if at != self._name("body", b):
            name = self._new(f"{self._name('body', b)}_fixed")
            _connect(robot, name, "fixed", (at, self._name("body", b)), (xyz, turn))

    def _add_joint(
        self,
        robot: etree._Element,
        j: int,
        links: tuple[str, str],
        origin: tuple[np.ndarray, Rotation],
        follows: Follows | None,
    ) -> None:
        m, name, sliding = self._m, self._name("joint", j), self._m.jnt_type[j] == self._sliding
        if follows and follows.source is None:
            _connect(robot, name, "fixed", links, origin)
            return
        limited = bool(m.jnt_limited[j])
        if sliding and not limited:
            more = "" if self._root else "; of a scene, take what one body carries: --root BODY"
            raise HandError(f"slide joint '{name}' has no range; give it one [m]{more}")
        kind = "prismatic" if sliding else "revolute" if limited else "continuous"
        joint = _connect(robot, name, kind, links, origin)
        etree.SubElement(joint, "axis", xyz=number_text(m.jnt_axis[j]))
        limit = etree.SubElement(joint, "limit")
        if limited:
            limit.set("lower", number_text(m.jnt_range[j, :1]))
            limit.set("upper", number_text(m.jnt_range[j, 1:]))
        if (effort := self._effort(j)) is not None:
            limit.set("effort", number_text([effort]))
        if follows and follows.source is not None:
            mimic = etree.SubElement(joint, "mimic", joint=self._name("joint", follows.source))
            mimic.set("multiplier", number_text([follows.multiplier]))
            mimic.set("offset", number_text([follows.offset]))

    def _effort(self, j: int) -> float | None:
        """Largest force or torque of a joint's actuators [N or N m]; None: not limited."""
        m, found = self._m, []
        if m.jnt_actfrclimited[j]:
            found.append(np.abs(m.jnt_actfrcrange[j]).max())
        for i in range(m.nu):
            if self._drives_joint(i) and m.actuator_trnid[i, 0] == j and (force := self._force(i)) is not None:
                found.append(force * abs(m.actuator_gear[i, 0]))
        return float(min(found)) if found else None

    def _force(self, i: int) -> float | None:
        """Largest force of an actuator before its gear; None: not limited."""
        m, lib, found = self._m, self._lib, []
        if m.actuator_forcelimited[i]:
            found.append(np.abs(m.actuator_forcerange[i]).max())
        kind = m.actuator_dyntype[i], m.actuator_gaintype[i], m.actuator_biastype[i]
        motor = kind == (int(lib.mjtDyn.mjDYN_NONE), int(lib.mjtGain.mjGAIN_FIXED), int(lib.mjtBias.mjBIAS_NONE))
        if motor and m.actuator_ctrllimited[i]:
            found.append(abs(m.actuator_gainprm[i, 0]) * np.abs(m.actuator_ctrlrange[i]).max())
        return min(found, default=None)

    def _note_drives(self) -> None:
        """Note joints that the file does not say enough of: how tendons share them, what drives them."""
        say = "where one follows another, say so (mimic)"
        free = [j for j in self._joints if j in self._moving and j not in self._follows]
        for terms in self._pulled:
            several = [self._name("joint", j) for j in terms if j in free]
            if len(several) > 1 and not terms.keys() & self._driven:
                self.notes.append(
                    f"note: one tendon drives {', '.join(several)}, which move each by itself here; {say}"
                )
        drives = self._driven.union(*self._pulled)
        drives |= {f.source for j, f in self._follows.items() if j in drives and f.source is not None}
        bare = [self._name("joint", j) for j in free if j not in drives]
        if drives and bare:
            self.notes.append(f"note: no actuator drives {', '.join(bare)}; {say}")

    def _note_passing(self) -> None:
        """Note links that never collide with each other in the file: here all links do."""
        m, passing = self._m, []
        excluded = {tuple(sorted(divmod(int(pair), 1 << 16))) for pair in m.exclude_signature}
        paired = {tuple(sorted(m.geom_bodyid[list(pair)])) for pair in zip(m.pair_geom1, m.pair_geom2, strict=True)}
        types = {}
        for b in self._bodies:
            own = slice(m.body_geomadr[b], m.body_geomadr[b] + m.body_geomnum[b])
            types[b] = np.stack([m.geom_contype[own], m.geom_conaffinity[own]], 1)
        for a, b in combinations([b for b in self._bodies if types[b].any()], 2):
            weld_a, weld_b = m.body_weldid[a], m.body_weldid[b]
            if weld_a == weld_b or m.body_weldid[m.body_parentid[weld_b]] == weld_a:  # neighbours never do
                continue
            meet = (types[a][:, None] & types[b][None, :, ::-1]).any()
            if (a, b) in excluded or not (meet or (a, b) in paired):
                passing.append(f"{self._name('body', a)} and {self._name('body', b)}")
        if passing:
            self.notes.append(
                f"note: {plural(len(passing), 'pair')} of links pass through each other in the file, such as "
                f"{passing[0]}; here all links collide, and grasps in which these do are refused"
            )


def _connect(
    robot: etree._Element, name: str, kind: str, links: tuple[str, str], origin: tuple[np.ndarray, Rotation]
) -> etree._Element:
    joint = etree.SubElement(robot, "joint", name=name, type=kind)
    for end, link in zip(("parent", "child"), links, strict=True):
        etree.SubElement(joint, end, link=link)
    set_origin(joint, *origin)
    return joint


def _rotation(quaternion: np.ndarray) -> Rotation:
    """From w, x, y, z."""
    return Rotation.from_quat(np.roll(quaternion, -1))
