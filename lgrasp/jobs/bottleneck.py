"""Why too few grasps came out, in words."""

_STEPS = (
    (
        "place",
        "tried",
        "kept",
        "the palm is in the object or the table, or no two fingers could oppose each other there",
    ),
    ("domain", "poses", "rich", "too few fingers can reach the object's surface at these poses"),
    ("ik", "tried", "kept", "fingers cannot put their contact surface on the object without hitting it"),
    ("close", "tried", "touching", "fingers do not touch the object as they close, or with an edge"),
    ("search", "poses", "yielding", "the contacts within reach do not balance, or the fingers would hit each other"),
    ("adjust", "tried", "kept", "fingers cannot make all contacts of a set, also where the object is moved a little"),
    ("filter", "", "kept", "finished grasps collide"),
    ("hold", "tried", "held", "grasps lose the object when it is pulled"),
    ("simulate", "tried", "held", "grasps lose the object in the physics simulation"),
)

_LOST = {
    "contact": "links are too far from the object where they should touch, or their surface is turned away from it "
    "(bounds.max_gap, bounds.max_normal_angle), or too few touch",
    "balance": "the contact forces do not balance with friction (bounds.max_gswo, bounds.friction)",
    "unresisted load": "the contacts do not resist pulls from all directions (bounds.max_unresisted_load)",
    "table": "the hand is in the table",
    "approach": "the open hand has no straight way to the object above the table",
    "touch": "too little of the normal force is on the region to touch; a smaller share or larger region gives more",
    "squeeze": "the joints hardly press on the object, push it out, close from far away or through it, or cannot "
    "open, a contact bears next to nothing, or epsilon is small; bounds.min_squeeze_travel=0, "
    "bounds.min_stable_squeeze=0, bounds.min_stable_pinch=0, bounds.max_closing_travel=10, "
    "bounds.max_closing_penetration=0.03, bounds.max_closing_sweep=1, bounds.min_pregrasp_opening=0, "
    "bounds.min_force_share=0 and bounds.min_epsilon=0 ask for nothing",
    "weak": "effort limits of the hand's joints leave too little force (lgrasp hands show tells them); "
    "bounds.min_squeeze_travel=0 asks for nothing",
}
"""Reasons of stage filter by its counts, where more than half of the grasps are lost by one; else they collide."""


def starving_stage(counts: dict[str, dict[str, int]]) -> tuple[str, str]:
    """The stage with the smallest share of survivors, by the ``counts`` of stages, and a sentence on it.

    Of what few reached the share is hardly known: one more is counted as tried and as surviving.
    """
    worst, least, words = "place", 2.0, "nothing was tried"
    for stage, before, after, reason in _STEPS:
        found = counts.get(stage)
        whole = (found.get(before, 0) if before else sum(found.values())) if found else 0
        if not found or not whole:
            continue
        share = (found.get(after, 0) + 1) / (whole + 1)
        reason = next((words for name, words in _LOST.items() if 2 * found.get(name, 0) > whole), reason)
        if share < least:
            worst, least = stage, share
            words = f"{found.get(after, 0):,} of {whole:,} survive: {reason}"
    return worst, words
