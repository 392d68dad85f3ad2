"""Reads the kinematic tree and the inertial parameters of an arm from a URDF."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.parsers import expat

import numpy as np

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import LoopError

AXIS_TOLERANCE = 1e-6  # of the length of a joint's axis, which URDF asks to be 1
MOVING_TYPES = ("revolute", "continuous", "prismatic")


class Kinematics(NamedTuple):
    """The moving joints of an arm, each before those that it carries, and the link behind each of them.

    `R, p`: orientation (3, 3) and place (3,) [m] of a joint's frame in that of the joint before it, all joints at 0;
    `axis`: in its own frame (3,).
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]  # index of the joint that carries it, -1 for the base
    prismatic: tuple[bool, ...]
    R: FloatArray  # (n, 3, 3)
    p: FloatArray  # (n, 3)
    axes: FloatArray  # (n, 3)
    inertial: FloatArray  # (n, 10): m, m c, and xx, xy, xz, yy, yz, zz of the inertia about the joint's frame (SI)
    limits: FloatArray  # (n, 2) lowest and highest position [rad or m]; infinite where none are given

    @property
    def size(self) -> int:
        """Number of joints n."""
        return len(self.names)


def parse_urdf(text: str, source: str) -> Kinematics:
    """Read the text of a URDF; links behind fixed joints are added to those that carry them.

    Raises LoopError, which calls it `source`, if it is xacro, or no tree of joints whose links have inertia.
    """
    parser = expat.ParserCreate("utf-8")
    data = text.encode()

    def refuse(*_: object) -> None:
        raise LoopError(f"{source}: declares entities or a document type, which a URDF does not need: remove them")

    parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse
    try:
        parser.Parse(data, True)
        root = ET.fromstring(data, ET.XMLParser(encoding="utf-8"))
    except (expat.ExpatError, ET.ParseError) as error:
        raise LoopError(f"{source}: is not XML ({error})") from None
    if root.tag != "robot":
        raise LoopError(f"{source}: is no URDF, its root is {root.tag!r} instead of 'robot'")
    if "${" in text or any(isinstance(element.tag, str) and "wiki/xacro" in element.tag for element in root.iter()):
        raise LoopError(f"{source}: is xacro, make a URDF of it first: xacro {Path(source).name} > arm.urdf")
    try:
        return _Tree(root).kinematics()
    except ValueError as error:
        raise LoopError(f"{source}: {error}") from None


class _Tree:
    """The links and joints of a document."""

    def __init__(self, root: ET.Element) -> None:
        self.links = {_name(link): link for link in root.iterfind("link")}
        self.joints: dict[str, list[ET.Element]] = {}
        carried = set()
        for joint in root.iterfind("joint"):
            parent, child = (_child(joint, key).get("link", "") for key in ("parent", "child"))
            if child in carried or joint.find("mimic") is not None:
                what = f"link {child!r} hangs on two joints" if child in carried else f"joint {_name(joint)!r} mimics"
                raise ValueError(f"{what}: parallel and coupled linkages are not supported, give a serial arm")
            for link in {parent, child} - self.links.keys():
                raise ValueError(f"joint {_name(joint)!r}: there is no link {link!r}")
            carried.add(child)
            self.joints.setdefault(parent, []).append(joint)
        self.bases = [name for name in self.links if name not in carried]

    def kinematics(self) -> Kinematics:
        """Return the moving joints, depth first."""
        if len(self.bases) != 1:
            raise ValueError(f"has {len(self.bases)} links that no joint carries, exactly one must be the base")
        chain: list[tuple[ET.Element, int, FloatArray, FloatArray]] = []
        inertial: list[FloatArray] = []
        apart = dict.fromkeys(self.links)
        waiting = [(self.bases[0], -1, np.eye(3), np.zeros(3))]
        while waiting:
            link, moving, R, p = waiting.pop()
            del apart[link]
            if moving >= 0:
                inertial[moving] += _inertial(self.links[link], R, p)
            for joint in reversed(self.joints.get(link, [])):
                child = _child(joint, "child").get("link", "")
                R_joint, p_joint = _pose(joint.find("origin"))
                R_joint, p_joint = R @ R_joint, p + R @ p_joint
                if joint.get("type") == "fixed":
                    waiting.append((child, moving, R_joint, p_joint))
                elif joint.get("type") in MOVING_TYPES:
                    chain.append((joint, moving, R_joint, p_joint))
                    inertial.append(np.zeros(10))
                    waiting.append((child, len(chain) - 1, np.eye(3), np.zeros(3)))
                else:
                    kind = joint.get("type")
                    raise ValueError(f"joint {_name(joint)!r}: joints of type {kind!r} are not supported")
        if apart:
            raise ValueError(
                f"link {next(iter(apart))!r} is carried in a circle of joints, none of which is on the base"
            )
        if not chain:
            raise ValueError("has no moving joint")
        names = tuple(_name(joint) for joint, *_ in chain)
        for name, parameters in zip(names, inertial, strict=True):
            if parameters[0] <= 0.0:
                raise ValueError(f"the link behind joint {name!r} has no inertia: add <inertial> with its mass")
            if not np.isfinite(parameters).all():
                raise ValueError(f"the inertia behind joint {name!r} is too large to count with: give SI units")
        return Kinematics(
            names,
            tuple(moving for _, moving, *_ in chain),
            tuple(joint.get("type") == "prismatic" for joint, *_ in chain),
            np.array([R for *_, R, _ in chain]),
            np.array([p for *_, p in chain]),
            np.array([_axis(joint) for joint, *_ in chain]),
            np.array(inertial),
            np.array([_limits(joint) for joint, *_ in chain]),
        )


def _name(element: ET.Element) -> str:
    name = element.get("name")
    if not name:
        raise ValueError(f"a {element.tag} has no name")
    return name


def _child(joint: ET.Element, key: str) -> ET.Element:
    child = joint.find(key)
    if child is None:
        raise ValueError(f"joint {_name(joint)!r} has no {key}")
    return child


def _numbers(text: str, count: int) -> FloatArray:
    try:
        numbers = np.array([float(part) for part in text.split()])
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"{text[:60]!r} is not {count} finite number{'s' * (count > 1)}")
    return numbers


def _pose(origin: ET.Element | None) -> tuple[FloatArray, FloatArray]:
    """Return orientation (3, 3) and place (3,) [m]; roll, pitch and yaw turn about the fixed axes x, y and z."""
    if origin is None:
        return np.eye(3), np.zeros(3)
    (cr, cp, cy), (sr, sp, sy) = (f(_numbers(origin.get("rpy", "0 0 0"), 3)) for f in (np.cos, np.sin))
    R = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.array(R), _numbers(origin.get("xyz", "0 0 0"), 3)


def _axis(joint: ET.Element) -> FloatArray:
    element = joint.find("axis")
    axis = _numbers(element.get("xyz", "1 0 0") if element is not None else "1 0 0", 3)
    length = float(np.linalg.norm(axis))
    if length < AXIS_TOLERANCE:
        raise ValueError(f"joint {_name(joint)!r}: its axis has no direction")
    return np.asarray(axis / length)


def _limits(joint: ET.Element) -> tuple[float, float]:
    limit = joint.find("limit")
    if limit is None or joint.get("type") == "continuous":
        return -np.inf, np.inf
    ends = (limit.get("lower"), -np.inf), (limit.get("upper"), np.inf)
    lowest, highest = (unlimited if text is None else float(_numbers(text, 1)[0]) for text, unlimited in ends)
    return lowest, highest


def _inertial(link: ET.Element, R: FloatArray, p: FloatArray) -> FloatArray:
    """Return the ten parameters of a link about a frame in which the link's own has a pose."""
    element = link.find("inertial")
    if element is None:
        return np.zeros(10)
    mass = _child_number(element, "mass", "value")
    R_own, p_own = _pose(element.find("origin"))
    R, c = R @ R_own, p + R @ p_own
    xx, xy, xz, yy, yz, zz = (
        _child_number(element, "inertia", key) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    about_centre = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ R.T
    return np.concatenate([[mass], mass * c, inertia_about(about_centre, mass, c)])


def _child_number(element: ET.Element, tag: str, key: str) -> float:
    child = element.find(tag)
    value = child.get(key) if child is not None else None
    if value is None:
        raise ValueError(f"an <inertial> has no {tag} {key}")
    return float(_numbers(value, 1)[0])


def inertia_about(about_centre: FloatArray, mass: float, c: Sequence[float] | FloatArray) -> FloatArray:
    """Return xx, xy, xz, yy, yz, zz of an inertia (3, 3) about a point from which the centre of mass is at c (3,)."""
    c = np.asarray(c)
    I = about_centre + mass * (c @ c * np.eye(3) - np.outer(c, c))
    return np.asarray(I[np.triu_indices(3)])
