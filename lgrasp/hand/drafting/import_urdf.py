"""Any URDF or MJCF -> a hand's folder: a URDF with its meshes beside it, and a drafted, commented hand.yaml."""

import hashlib
import itertools
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import trimesh
from lxml import etree

from lgrasp.errors import HandError, LgraspError, OutputError
from lgrasp.files import new_folder, temporary_folder
from lgrasp.geometry.mesh_files import mesh_bytes
from lgrasp.hand.build import build_hand
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.drafting.cut_hand import cut_hand, hand_roots
from lgrasp.hand.drafting.draft import draft_spec
from lgrasp.hand.drafting.mjcf import mjcf_to_urdf
from lgrasp.hand.drafting.two_jaw import find_jaws, reroot
from lgrasp.hand.drafting.write import write_spec
from lgrasp.hand.find import rules_of_known
from lgrasp.hand.geometry import MOST_FACES, read_mesh, thin_mesh
from lgrasp.hand.names import known_hands, name_of_file, slug
from lgrasp.hand.spec import Box, ContactRule, HandSpec, load_spec
from lgrasp.hand.urdf import MOVABLE, check_robot, find_mesh, is_mjcf, joint_end, read_robot
from lgrasp.paths import cache_dir, data_dirs, free_name, is_litter, user_dir, user_path
from lgrasp.words import listed

_DRAFT_VERSION = 9
FindMesh = Callable[[str, str], Path]  # (link, name in the URDF) -> file
_LARGE_FILE = 5_000_000  # bytes of a mesh file that is worth looking into
_FEW = 8  # links that are named
_MOST_OTHERS = 30  # files that are asked for couplings


@dataclass(frozen=True)
class ImportedHand:
    """A hand that was added."""

    folder: Path
    spec: HandSpec
    decisions: list[str]


def import_urdf(
    file: Path,
    *,
    name: str | None = None,
    out: Path | None = None,
    force: bool = False,
    root: str | None = None,
    mesh_dirs: Sequence[Path] = (),
) -> ImportedHand:
    """Make a hand's folder from a URDF, or from an MJCF; the folder appears whole or not at all.

    Args:
        file: URDF or MJCF.
        name: default: ``root``, else the file's name, or the robot's when the file is called hand.urdf or the like.
        out: default: the user's data folder, ``hands/NAME``.
        force: replace what is there.
        root: the hand is what is below this link of a robot.
        mesh_dirs: folders in which meshes are looked for as well, see :func:`lgrasp.hand.urdf.find_mesh`.

    Raises:
        HandError: the file cannot be used, or the folder exists.
        PhysicsError: an MJCF, and MuJoCo is not installed.
    """
    with _as_urdf(file, root, mesh_dirs) as (urdf, notes):
        robot, raw = read_robot(urdf)
        hands = hand_roots(robot) if root is None else []
        if root is not None:
            cut_hand(urdf, robot, root)
        source = check_robot(urdf, robot, raw, mesh_dirs)
        name = name or (slug(root) if root else name_of_file(file, source.name))
        if name != slug(name):
            raise HandError(
                f"hand name '{name}' may hold letters, digits, '.', '_' and '-' only, such as '{slug(name)}'"
            )
        folder = user_path(out) if out is not None else user_dir("hands") / name
        if os.path.lexists(folder) and not force:
            raise HandError(
                f"hand folder {folder} exists; choose another --name or --out, or replace it with --overwrite"
            )
        if out is None and not force and (known := known_hands().get(name)):
            raise HandError(f"hand '{name}' is in {known}; choose another --name, or hide that one with --overwrite")
        no_hand = folder.exists() and not (folder / "hand.yaml").is_file()
        if no_hand and not (folder.is_dir() and all(is_litter(path.name) for path in folder.iterdir())):
            raise HandError(f"{folder} holds something that is no hand (it has no hand.yaml); choose another --out")
        originals: dict[Path, Path] = {}
        try:
            with new_folder(folder) as made:
                originals[made / "hand.urdf"] = urdf
                meshes = partial(find_mesh, urdf, mesh_dirs=mesh_dirs)
                spec, changes = _fill(robot, file, name, made, meshes, originals, notes)
        except OutputError as error:
            raise HandError(f"{error}; choose another with --out") from None
        except LgraspError as error:
            # messages name the user's files, not copies that are gone
            text = str(error)
            for copy, original in originals.items():
                text = text.replace(str(copy.resolve()), str(original)).replace(str(copy), str(original))
            if hands:
                text += f"; of a whole robot, take one hand: lgrasp hands add {urdf} --root {hands[0]}"
                text += f" (links that carry hands: {', '.join(hands)})" if len(hands) > 1 else ""
            raise type(error)(text) from None
        return ImportedHand(folder, spec, changes)


@contextmanager
def _as_urdf(file: Path, root: str | None, mesh_dirs: Sequence[Path]) -> Iterator[tuple[Path, list[str]]]:
    """A URDF itself; for an MJCF one that is made of it and goes with the block, and what it cannot say. Errors of the
    block name the file."""
    if not is_mjcf(file):
        yield file, []
        return
    with temporary_folder() as folder:
        urdf, notes = mjcf_to_urdf(file, folder, root=root, mesh_dirs=mesh_dirs)
        try:
            yield urdf, notes
        except LgraspError as error:
            text = str(error).replace(f"URDF {urdf}", f"MJCF {file}").replace(str(urdf), str(file))
            raise type(error)(text.replace(f"{folder}/", "")) from None


def _fill(
    robot: etree._Element,
    file: Path,
    name: str,
    folder: Path,
    find: FindMesh,
    originals: dict[Path, Path],
    notes: list[str],
) -> tuple[HandSpec, list[str]]:
    """Write URDF, meshes and hand.yaml, with notes on the file, into a folder and build the hand once."""
    for note in [e for e in robot.iter() if not isinstance(e.tag, str)]:
        if note.getparent() is not None:
            note.getparent().remove(note)
    changes = [*notes, *_take_visuals(robot)]
    changes += _take_meshes(robot, folder, find, originals)
    target = folder / "hand.urdf"
    _write(robot, target)
    changes += _take_couplings(robot, target)
    if jaws := find_jaws(target):
        reroot(robot, jaws[0])
        _write(robot, target)
        changes.append(
            f"one drive moves both jaws: '{jaws[0]}' is made the base (the copy of the URDF is turned round; joint "
            f"values mean the same), so that '{jaws[1]}' closes against it as against a palm"
        )
    changes += _left_out_couplings(file, robot)
    spec, decided = draft_spec(target, name, jaws=jaws)
    spec = spec.model_copy(update={"source": f"drafted by lgrasp hands add from {file.name}"})
    changes += decided
    write_spec(spec, folder / "hand.yaml", changes)
    written = load_spec(folder / "hand.yaml")
    build_hand(target, written)
    return written, changes


def _take_couplings(robot: etree._Element, target: Path) -> list[str]:
    """Write the couplings of the shipped hand of these joints and links into a URDF that does not state them."""
    known = rules_of_known(target, [path.parent for path in _shipped_hands()])
    if known is None or not known.spec.mimic:
        return []
    for joint in robot.findall("joint"):
        if coupling := known.spec.mimic.get(joint.get("name", "")):
            etree.SubElement(joint, "mimic", {name: str(value) for name, value in coupling})
    _write(robot, target)
    joints = ", ".join(known.spec.mimic)
    return [f"couplings of {joints}: those of a shipped hand with the same joints and links (<mimic> in hand.urdf)"]


def _left_out_couplings(urdf: Path, robot: etree._Element) -> list[str]:
    """Couplings that a file leaves out, at most one line: joints without <mimic> that another URDF of the folder, or a
    shipped one, couples; all joints of that URDF are joints of this ``robot``."""
    names, coupled = _joints(robot)
    beside = (path for path in sorted(urdf.parent.glob("*.urdf")) if path.name != urdf.name)
    for other in itertools.islice(itertools.chain(_shipped_hands(), beside), _MOST_OTHERS):
        try:
            its_names, its_coupled = _joints(read_robot(other)[0])
        except HandError:
            continue
        if its_names <= names and (missing := sorted(its_coupled - coupled)):
            return [
                f"note: this file does not couple {', '.join(missing)}, which {other} does: if they have no drive of "
                "their own, say so (mimic)"
            ]
    return []


def _shipped_hands() -> list[Path]:
    return sorted(data_dirs("hands")[-1].glob("*/hand.urdf"))


def _joints(robot: etree._Element) -> tuple[set[str], set[str]]:
    """Names of the joints that move, and of those that mimic another."""
    moving = [joint for joint in robot.findall("joint") if joint.get("type") in MOVABLE]
    return {j.get("name", "") for j in moving}, {j.get("name", "") for j in moving if j.find("mimic") is not None}


def _write(robot: etree._Element, path: Path) -> None:
    path.write_bytes(etree.tostring(robot, xml_declaration=True, encoding="utf-8", pretty_print=True))


def _take_visuals(robot: etree._Element) -> list[str]:
    """Where no link has collision geometry, the visual geometry is it."""
    visuals = robot.findall("link/visual")
    if robot.find("link/collision") is not None:
        return _ghosts(robot)
    if not visuals:
        return []
    for visual in visuals:
        collision = etree.SubElement(visual.getparent(), "collision")
        # copies without what follows them
        copies = (etree.fromstring(etree.tostring(part)) for part in visual if part.tag in ("origin", "geometry"))
        collision.extend(copies)
    return [f"no link has collision geometry: the visual geometry of {len(visuals)} elements is used as collision"]


def _ghosts(robot: etree._Element) -> list[str]:
    """A note on links that joints move and that can be seen, but touch nothing."""
    solid = {link.get("name", "") for link in robot.findall("link") if link.find("collision") is not None}
    seen = {link.get("name", "") for link in robot.findall("link") if link.find("visual") is not None}
    moved = [joint_end(joint, "child") for joint in robot.findall("joint") if joint.get("type") in MOVABLE]
    ghosts = [link for link in moved if link in seen and not solid & {*_rigid(robot, link)}]
    if not ghosts:
        return []
    return [
        f"note: {listed(ghosts, _FEW)}: visual geometry, but no <collision>: nothing touches there; copy <visual> to "
        "<collision> if fingers should"
    ]


def _rigid(robot: etree._Element, link: str) -> Iterator[str]:
    """A link and those that are fixed to it, below."""
    yield link
    for joint in robot.findall("joint"):
        if joint.get("type") not in MOVABLE and joint_end(joint, "parent") == link:
            yield from _rigid(robot, joint_end(joint, "child"))


def _take_meshes(robot: etree._Element, folder: Path, find: FindMesh, originals: dict[Path, Path]) -> list[str]:
    """Copy every mesh to meshes/collision or meshes/visual and name it there; huge collision meshes are thinned.

    ``originals`` gets the file that each copy was made from.
    """
    changes: list[str] = []
    for kind in ("collision", "visual"):
        copied: dict[Path, str] = {}
        for element in robot.findall(f"link/{kind}"):
            for mesh in list(element.iter("mesh")):
                link = element.getparent().get("name")
                try:
                    file = find(link, mesh.get("filename", ""))
                except HandError as error:
                    if kind == "collision":
                        raise
                    element.getparent().remove(element)
                    changes.append(
                        f"link '{link}': visual mesh left out ({str(error).split(': ', 1)[-1].split('; ')[0]})"
                    )
                    break
                if file not in copied:
                    copied[file] = _copy_mesh(file, folder, kind, set(copied.values()), changes)
                    originals[folder / copied[file]] = file
                mesh.set("filename", copied[file])
    return changes


def _copy_mesh(file: Path, folder: Path, kind: str, taken: set[str], changes: list[str]) -> str:
    """Path, relative to the folder, of the copy of a mesh."""
    base = f"meshes/{kind}/{slug(file.stem)}"
    whole = _rewritten(file, huge=kind == "collision")
    suffix = file.suffix.lower() if whole is None else ".stl"
    name = free_name(base, suffix, taken)
    target = folder / name
    target.parent.mkdir(parents=True, exist_ok=True)
    if whole is not None:
        mesh = thin_mesh(whole, MOST_FACES)
        mesh.export(target)
        if mesh is not whole:
            changes.append(f"collision mesh {file.name} has {len(whole.faces):,} faces: thinned to {len(mesh.faces):,}")
        return name
    shutil.copyfile(file, target)
    if suffix == ".obj":
        for library in re.findall(rb"^mtllib\s+(.+?)\s*$", file.read_bytes(), re.MULTILINE):
            material = file.parent / Path(library.decode("utf-8", "replace")).name
            if material.is_file() and material.resolve().is_relative_to(file.parent):
                shutil.copyfile(material, target.parent / material.name)
    return name


def _rewritten(file: Path, *, huge: bool) -> trimesh.Trimesh | None:
    """A mesh of several files, or a ``huge`` one to be thinned; None for others, and for what cannot be read (reported
    later)."""
    several = file.suffix.lower() == ".gltf"
    if not several and not (huge and file.stat().st_size >= _LARGE_FILE):
        return None
    try:
        mesh_bytes(file)  # refuses files outside the mesh's folder
        mesh = read_mesh(file)
    except Exception:
        return None
    return mesh if several or len(mesh.faces) > MOST_FACES else None


def drafted_folder(urdf: Path, name: str) -> Path:
    """Folder of a hand drafted from a package's URDF, kept in the cache.

    Raises:
        HandError: see :func:`import_urdf`.
    """
    box = Box(min=(0, 0, 0), max=(1, 1, 1))
    content = hand_digest(urdf, HandSpec(name=name, contact=(ContactRule(links=("-",)),), canonical_box=box))
    key = hashlib.sha256(f"{_DRAFT_VERSION} {content}".encode()).hexdigest()
    folder = cache_dir() / "drafts" / key[:32] / name
    try:
        load_spec(folder / "hand.yaml")
    except HandError:  # not drafted yet, or unreadable
        import_urdf(urdf, name=name, out=folder, force=folder.exists())
    return folder
