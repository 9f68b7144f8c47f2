"""Spanning tree of a model and loop-closing joints, as required by programs in joint coordinates."""

from __future__ import annotations

from typing import Any

from twoloop.bodies.parts import Body, ModelJoint

# kinds of joints in the order in which they enter the tree: those that cannot close a loop first
TREE = ("prismatic", "cylindrical", "universal", "planar", "revolute", "fixed", "spherical")
LOOP = ("spherical", "revolute", "fixed")


def spanning_tree(model: Any) -> tuple[dict[int, tuple[Body, ModelJoint]], list[ModelJoint]]:
    """Return the parent and joint of each body, by its number, and the joints that close loops.

    Raises
    ------
    ValueError
        If MJCF has no counterpart of a joint, or cannot close a loop with it.
    """
    joints = [each for each in model.joints if each.kind != "drive"]
    wrong = [each for each in joints if each.kind not in TREE]
    if wrong:
        raise ValueError(f"MJCF has no counterpart of {wrong[0].name!r}, which is {wrong[0].kind}")
    linked = {each.number: {each.number} for each in (model.ground, *model.bodies)}
    edges: list[ModelJoint] = []
    loops: list[ModelJoint] = []
    # joints to the ground first within each kind: loops are then cut between moving bodies, and branches are shorter
    for joint in sorted(joints, key=lambda each: (TREE.index(each.kind), model.ground not in (each.a, each.b))):
        one, other = linked[joint.a.number], linked[joint.b.number]
        if one is other:
            loops.append(joint)
            continue
        edges.append(joint)
        one |= other
        linked |= dict.fromkeys(other, one)
    wrong = [each for each in loops if each.kind not in LOOP]
    if wrong:
        raise ValueError(
            f"{wrong[0].name!r} closes a loop, which in MJCF {' and '.join(LOOP)} joints can; it is {wrong[0].kind}"
        )
    parents: dict[int, tuple[Body, ModelJoint]] = {}
    ahead: list[Body] = [model.ground, *model.bodies]
    reached: set[int] = set()
    for root in ahead:
        stack = [] if root.number in reached else [root]
        while stack:
            body = stack.pop()
            reached.add(body.number)
            for joint in edges:
                child = joint.b if joint.a is body else joint.a if joint.b is body else None
                if child is not None and child.number not in reached:
                    parents[child.number] = body, joint
                    stack.append(child)
    return parents, loops
