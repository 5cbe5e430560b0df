"""URDFs that tests write: grippers, plain fingers, a hand turned round or mirrored."""

from pathlib import Path

from lxml import etree

from lgrasp.hand.urdf import read_urdf

JAW = '<origin xyz="{x} 0 0.03"/><geometry><box size="0.01 0.02 0.06"/></geometry>'
SLIDE = '<joint name="{n}" type="prismatic"><parent link="base"/><child link="jaw_{n}"/><origin xyz="0 0 0.035"/>{rest}'
LIMIT = '<limit lower="0" upper="0.05" effort="1" velocity="1"/>'
PHALANX = '<link name="{n}"><collision><origin xyz="0 0 0.025"/>{geometry}</collision></link>'
HINGE = (
    '<joint name="{n}" type="revolute"><parent link="{p}"/><child link="{c}"/><origin xyz="0 {y} {z}"/>'
    '<axis xyz="{s} 0 0"/><limit lower="-0.2" upper="{u}"/></joint>'
)
BAR = '<geometry><box size="0.015 0.015 0.05"/></geometry>'
BASE = '<link name="base"><collision><geometry><box size="0.04 0.1 0.03"/></geometry></collision></link>'

ARM_HEIGHTS = (0.3, 0.0, 0.2, 0.2, 0.2, 0.2, 0.1)
ARM_LINK = (
    '<link name="{n}"><collision><origin xyz="0 0 {half}"/><geometry><cylinder radius="0.03" length="{size}"/>'
    "</geometry></collision></link>"
)
ARM_JOINT = (
    '<joint name="turn_{i}" type="revolute"><parent link="{p}"/><child link="{c}"/><origin xyz="0 0 {z}"/>'
    '<axis xyz="{axis}"/><limit lower="-{most}" upper="{most}"/></joint>'
)


def arm(folder: Path, more: str = "", bend: float = 2.1) -> Path:
    """An upright arm of seven joints that turn about z and y in turn, 1.25 m long; ``more`` links and joints."""
    links, joints = ['<link name="base"/>'], []
    for i, z in enumerate(ARM_HEIGHTS):
        size = [*ARM_HEIGHTS, 0.05][i + 1] or 0.05
        links.append(ARM_LINK.format(n=f"arm_{i}", half=size / 2, size=size))
        about = {"axis": "0 1 0", "most": bend} if i % 2 else {"axis": "0 0 1", "most": 2.9}
        joints.append(ARM_JOINT.format(i=i, p=f"arm_{i - 1}" if i else "base", c=f"arm_{i}", z=z, **about))
    joints.append('<joint name="end" type="fixed"><parent link="arm_6"/><child link="flange"/>')
    joints.append('<origin xyz="0 0 0.05" rpy="0 0 0.5"/></joint><link name="flange"/>')
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm">{"".join(links)}{"".join(joints)}{more}</robot>')
    return path


def gripper(folder: Path, *, mimic: bool = False, kind: str = "collision") -> Path:
    """Two prismatic jaws."""
    base = f'<link name="base"><{kind}><geometry><box size="0.12 0.05 0.06"/></geometry></{kind}></link>'
    jaws = "".join(
        f'<link name="jaw_{n}"><{kind}>{JAW.format(x=x)}</{kind}></link>' for n, x in (("l", 0.005), ("r", -0.005))
    )
    rest = '<axis xyz="{s} 0 0"/>' + LIMIT
    left = SLIDE.format(n="l", rest=rest.format(s=1)) + "</joint>"
    right = SLIDE.format(n="r", rest=rest.format(s=-1)) + ('<mimic joint="l"/>' if mimic else "") + "</joint>"
    path = folder / "jaws.urdf"
    path.write_text(f'<robot name="jaws">{base}{jaws}{left}{right}</robot>')
    return path


def fingers(folder: Path, count: int, tip: str = BAR, upper: float = 1.5) -> Path:
    """Two fingers of two hinges, or one that has nothing to close against."""
    base = BASE if count > 1 else BASE.replace("0.04 0.1 0.03", "0.03 0.03 0.03")
    parts = []
    for i, (y, s) in enumerate(((0.04, 1), (-0.04, -1)) if count > 1 else ((0.0, 1),)):
        parts += [PHALANX.format(n=f"a{i}", geometry=BAR), PHALANX.format(n=f"b{i}", geometry=tip)]
        parts.append(HINGE.format(n=f"j{i}", p="base", c=f"a{i}", y=y, z=0.02, s=s, u=upper))
        parts.append(HINGE.format(n=f"k{i}", p=f"a{i}", c=f"b{i}", y=0, z=0.06, s=s, u=upper))
    path = folder / "fingers.urdf"
    path.write_text(f'<robot name="fingers">{base}{"".join(parts)}</robot>')
    return path


def rods(folder: Path) -> Path:
    """Two fingers in a row and a thumb that faces them, of three rods with flat ends; they bend to -y of a link."""
    rod = '<link name="{n}"><collision><origin xyz="0 0 0.0175"/><geometry><cylinder radius="0.008" length="0.035"/>'
    hinge = (
        '<joint name="{n}_joint" type="revolute"><parent link="{p}"/><child link="{n}"/>'
        '<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="1 0 0"/><limit lower="-0.2" upper="1.6"/></joint>'
    )
    places = {"f": ("0.03 0 0.045", "0 0 0"), "g": ("-0.03 0 0.045", "0 0 0"), "t": ("0 -0.02 -0.02", "-1.2 0 3.1416")}
    parts = []
    for name, (xyz, rpy) in places.items():
        for i in range(3):
            at = {"xyz": "0 0 0.035", "rpy": "0 0 0"} if i else {"xyz": xyz, "rpy": rpy}
            parts.append(rod.format(n=f"{name}{i}") + "</geometry></collision></link>")
            parts.append(hinge.format(n=f"{name}{i}", p=f"{name}{i - 1}" if i else "base", **at))
    path = folder / "rods.urdf"
    path.write_text(f'<robot name="rods">{BASE.replace("0.04 0.1 0.03", "0.08 0.02 0.09")}{"".join(parts)}</robot>')
    return path


def turned(source: Path, folder: Path, rpy: str, *, mirror: bool = False) -> Path:
    """A primitive URDF under a new root, rotated; or its mirror image (x to -x)."""
    robot = etree.parse(str(source)).getroot()
    if mirror:
        for origin in robot.iter("origin"):
            x, y, z = map(float, origin.get("xyz", "0 0 0").split())
            r, p, w = map(float, origin.get("rpy", "0 0 0").split())
            origin.set("xyz", f"{-x} {y} {z}")
            origin.set("rpy", f"{r} {-p} {-w}")
        for axis in robot.iter("axis"):
            x, y, z = map(float, axis.get("xyz").split())
            axis.set("xyz", f"{x} {-y} {-z}")  # axial vectors turn the other way
    root = read_urdf(source).root
    etree.SubElement(robot, "link", name="mount")
    joint = etree.SubElement(robot, "joint", name="mounting", type="fixed")
    etree.SubElement(joint, "parent", link="mount")
    etree.SubElement(joint, "child", link=root)
    etree.SubElement(joint, "origin", xyz="0.1 -0.2 0.3", rpy=rpy)
    path = folder / "turned.urdf"
    path.write_bytes(etree.tostring(robot))
    return path
