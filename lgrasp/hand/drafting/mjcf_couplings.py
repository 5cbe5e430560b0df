"""Equalities of an MJCF as couplings of joints: each joint linear in the one that drives it."""

from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

from lgrasp.errors import HandError

_EQUAL = 1.0e-9  # of coefficients, and of offsets [rad or m]


class Follows(NamedTuple):
    """A joint's value is ``multiplier`` times that of joint ``source``, plus ``offset`` [rad or m]."""

    source: int | None
    """None: the value is the offset."""
    multiplier: float
    offset: float


class _Equation(NamedTuple):
    """The sum of ``terms`` (joint -> coefficient) is ``value``."""

    name: str
    terms: dict[int, float]
    value: float


def couplings(
    model: Any, joints: Collection[int], bodies: Collection[int], driven: Collection[int]
) -> dict[int, Follows]:
    """Joint -> what it follows, of the joints of a compiled model that equalities couple.

    Args:
        joints: those of the hand.
        bodies: those of the hand.
        driven: joints that others rather follow than they others.

    Raises:
        HandError: an equality of the hand that is no linear coupling of two joints.
    """
    near: dict[int | None, list[tuple[int, float, float]]] = {}  # of a joint: (other, multiplier, offset)
    for name, terms, value in _equations(model, set(bodies)):
        if not terms.keys() & set(joints):
            continue
        if missing := terms.keys() - set(joints):
            outside = model.joint(min(missing)).name
            raise HandError(f"equality {name} couples a joint of the hand to '{outside}', which is not below --root")
        if len(terms) > 2:
            names = ", ".join(model.joint(j).name for j in terms)
            raise HandError(f"equality {name} couples {names}: a joint may follow one other, not several")
        if len(terms) == 1:
            ((a, c),) = terms.items()
            near.setdefault(None, []).append((a, 0.0, value / c))
            near.setdefault(a, [])
            continue
        (a, c), (b, d) = terms.items()
        near.setdefault(a, []).append((b, -c / d, value / d))
        near.setdefault(b, []).append((a, -d / c, value / c))
    return _solve(model, near, driven)


def _solve(
    model: Any, near: dict[int | None, list[tuple[int, float, float]]], driven: Collection[int]
) -> dict[int, Follows]:
    """From couplings of neighbours to the one joint that each follows."""
    found: dict[int | None, Follows] = {}
    joints = sorted(j for j in near if j is not None)
    for root in (None, *(j for j in joints if j in driven), *joints):
        if root in found or root not in near:
            continue
        found[root] = Follows(root, 1.0, 0.0)
        waiting: list[int | None] = [root]
        while waiting:
            at = waiting.pop()
            for other, m, b in near[at]:
                via = Follows(root, m * found[at].multiplier, m * found[at].offset + b)
                if other not in found:
                    found[other] = via
                    waiting.append(other)
                elif max(abs(x - y) for x, y in zip(via[1:], found[other][1:], strict=True)) > _EQUAL:
                    raise HandError(f"equalities of joint '{model.joint(other).name}' exclude each other")
    return {j: follows for j, follows in found.items() if j is not None and follows.source != j}


def _equations(model: Any, bodies: set[int]) -> Iterator[_Equation]:
    import mujoco

    for i in range(model.neq):
        if not model.eq_active0[i]:
            continue
        kind, name = mujoco.mjtEq(model.eq_type[i]), f"'{model.equality(i).name or i}'"
        ends = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        if kind in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD):
            site = model.eq_objtype[i] == int(mujoco.mjtObj.mjOBJ_SITE)
            held = {int(model.site_bodyid[end]) if site else end for end in ends}
            if held <= bodies:
                names = " and ".join(f"'{model.body(b).name}'" for b in sorted(held))
                what = kind.name.removeprefix("mjEQ_").lower()
                raise HandError(
                    f"equality {name} ({what}) closes a loop between bodies {names}; joint loops are not supported: "
                    "couple the joints by <equality><joint .../></equality> instead"
                )
        elif kind in (mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtEq.mjEQ_TENDON):
            yield _equation(model, name, ends, model.eq_data[i], tendons=kind == mujoco.mjtEq.mjEQ_TENDON)


def _equation(model: Any, name: str, ends: tuple[int, int], data: Any, *, tendons: bool) -> _Equation:
    """y - y0 = a0 + a1 (x - x0), of two joints or two tendons, or of one."""
    terms: dict[int, float] = {}
    value, factors = float(data[0]), (1.0, -float(data[1]))
    for end, factor in zip(ends, factors, strict=True):
        if end < 0 or factor == 0.0:
            continue
        parts = tendon_terms(model, end) if tendons else {end: 1.0}
        if parts is None:
            raise HandError(f"equality {name} holds a spatial tendon, which is no linear coupling of joints")
        at_rest = model.tendon_length0[end] if tendons else model.qpos0[model.jnt_qposadr[end]]
        value += factor * float(at_rest)
        for joint, c in parts.items():
            terms[joint] = terms.get(joint, 0.0) + factor * c
    if ends[1] >= 0 and any(abs(x) > _EQUAL for x in data[2:5]):
        raise HandError(
            f"equality {name} is no linear coupling (polycoef {' '.join(f'{x:g}' for x in data[:5])}); only its first "
            "two numbers may be other than 0"
        )
    return _Equation(name, {joint: c for joint, c in terms.items() if abs(c) > _EQUAL}, value)


def tendon_terms(model: Any, tendon: int) -> dict[int, float] | None:
    """Joint -> coefficient of a fixed tendon; None of a spatial one."""
    import mujoco

    first = model.tendon_adr[tendon]
    parts = range(first, first + model.tendon_num[tendon])
    if any(model.wrap_type[k] != int(mujoco.mjtWrap.mjWRAP_JOINT) for k in parts):
        return None
    return {int(model.wrap_objid[k]): float(model.wrap_prm[k]) for k in parts}
