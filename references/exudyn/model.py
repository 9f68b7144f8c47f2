"""Building blocks of Exudyn models of rigid bodies: bodies, joints, springs and gravity."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from references.exudyn.run import add_sensors, exu, items
from twoloop.bodies.rotation import rotation_matrix
from twoloop.problem.problem import Array, Problem

GROUND = -1
# locked translations and rotations of the second body in the frame of a joint
SPHERICAL, UNIVERSAL = [1, 1, 1, 0, 0, 0], [1, 1, 1, 0, 0, 1]  # x of the first and y of the second stay perpendicular
REVOLUTE, PRISMATIC = [1, 1, 1, 1, 1, 0], [0, 1, 1, 1, 1, 1]  # about z, along x


class Model:
    """Exudyn's container and system, with methods that add bodies and connections."""

    def __init__(self, gravity: ArrayLike):
        self.container = exu.SystemContainer()
        self.mbs: Any = self.container.AddSystem()
        self.gravity = np.asarray(gravity, dtype=float).tolist()
        self.bodies: list[int] = []
        self.nodes: list[int] = []
        self.sensors: list[list[int]] = []
        self.places: list[tuple[Array, Array]] = []  # initial centre and rotation matrix of each body
        self.reference: list[Array] = []
        self.ground = self.mbs.AddObject(items.ObjectGround(referencePosition=[0.0, 0.0, 0.0]))

    def _added(self, body: int, node: int, q: Array, place: tuple[Array, Array]) -> int:
        whole = self.mbs.AddMarker(items.MarkerBodyMass(bodyNumber=body))
        self.mbs.AddLoad(items.LoadMassProportional(markerNumber=whole, loadVector=self.gravity))
        self.bodies.append(body)
        self.nodes.append(node)
        self.reference.append(np.asarray(q, dtype=float))
        self.places.append(place)
        self.sensors.append(add_sensors(self.mbs, node))
        return len(self.bodies) - 1

    def body(self, mass: float, inertia: ArrayLike, q: Array, v: Array) -> int:
        """Add a body in space: moments xx, yy, zz, yz, xz, xy or the first three; centre, Euler parameters, rates."""
        node = self.mbs.AddNode(items.NodeRigidBodyEP(referenceCoordinates=q.tolist(), initialVelocities=v.tolist()))
        moments = [*np.asarray(inertia, dtype=float).tolist(), 0.0, 0.0, 0.0][:6]
        body = self.mbs.AddObject(items.ObjectRigidBody(mass=mass, inertia=moments, nodeNumber=node))
        return self._added(body, node, q, (q[:3], rotation_matrix(q[3:])))

    def planar_body(self, mass: float, inertia: float, q: Array, v: Array) -> int:
        """Add a body in the plane: centre and angle (3,), and their rates."""
        node = self.mbs.AddNode(items.NodeRigidBody2D(referenceCoordinates=q.tolist(), initialVelocities=v.tolist()))
        body = self.mbs.AddObject(items.ObjectRigidBody2D(mass=mass, inertia=inertia, nodeNumber=node))
        return self._added(body, node, q, (np.zeros(3), np.eye(3)))

    def planar_bodies(self, masses: Iterable[float], inertias: Iterable[float], problem: Problem) -> None:
        """Add planar bodies with the initial states of those of a problem."""
        states = zip(problem.q0.reshape(-1, 3), problem.v0.reshape(-1, 3), strict=True)
        for mass, inertia, state in zip(masses, inertias, states, strict=True):
            self.planar_body(float(mass), float(inertia), *state)

    def _local(self, body: int, point: ArrayLike) -> tuple[int, list[float], Array]:
        """Return Exudyn's number of a body, a point of space in body axes, and its rotation matrix."""
        point = np.asarray(point, dtype=float)
        if body == GROUND:
            return self.ground, point.tolist(), np.eye(3)
        centre, R = self.places[body]
        return self.bodies[body], (R.T @ (point - centre)).tolist(), R

    def joint(self, i: int, j: int, point: ArrayLike, frame: Array, locked: list[int]) -> int:
        """Lock motions of body j relative to i in the axes of a frame at a point, both given in space at the start."""
        markers = []
        for body in (i, j):
            number, local, R = self._local(body, point)
            place = exu.HT(rotation=R.T @ frame, translation=local)  # type: ignore[call-arg]  # its stub lags behind
            markers.append(self.mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=number, localHT=place)))
        return int(self.mbs.AddObject(items.GenericJoint(markerNumbers=markers, constrainedAxes=locked)))

    def spring(self, i: int, a: ArrayLike, j: int, b: ArrayLike, *data: float) -> None:
        """Add a spring-damper between two points given in space at the start: stiffness, damping, length."""
        stiffness, damping, length = data
        markers = [self._marker(*self._local(body, point)[:2]) for body, point in ((i, a), (j, b))]
        properties: dict[str, Any] = {"stiffness": stiffness, "damping": damping, "referenceLength": length}
        self.mbs.AddObject(items.ObjectConnectorSpringDamper(markerNumbers=markers, **properties))

    def pin(self, i: int, a: tuple[float, float], j: int, b: tuple[float, float]) -> int:
        """Add a pin between points of two planar bodies, each in body axes."""
        numbers = (self.ground if body == GROUND else self.bodies[body] for body in (i, j))
        markers = [self._marker(number, [*point, 0.0]) for number, point in zip(numbers, (a, b), strict=True)]
        return int(self.mbs.AddObject(items.ObjectJointRevolute2D(markerNumbers=markers)))

    def _marker(self, number: int, local: list[float]) -> int:
        return int(self.mbs.AddMarker(items.MarkerBodyPosition(bodyNumber=number, localPosition=local)))

    def torque(self, body: int, torque: ArrayLike) -> None:
        """Add a constant torque on a body, along the axes of space."""
        marker = self.mbs.AddMarker(items.MarkerBodyRigid(bodyNumber=self.bodies[body]))
        self.mbs.AddLoad(
            items.LoadTorqueVector(markerNumber=marker, loadVector=np.asarray(torque, dtype=float).tolist())
        )

    def turn(self, body: int, stiffness: float, damping: float, angle: float) -> None:
        """Add a torsional spring between the ground and a planar body, unstressed at the rotation `angle`."""
        properties: dict[str, Any] = {"stiffness": stiffness, "damping": damping, "offset": angle}
        self.mbs.AddObject(
            items.ObjectConnectorCoordinateSpringDamper(markerNumbers=self._coordinate(body, 2), **properties)
        )

    def twist(self, joint: int, stiffness: float, damping: float, angle: float) -> None:
        """Add a torsional spring about z of the markers of a joint, unstressed at the rotation `angle`."""
        markers = self.mbs.GetObject(joint)["markerNumbers"]
        properties: dict[str, Any] = {"stiffness": stiffness, "damping": damping, "offset": angle}
        self.mbs.AddObject(items.TorsionalSpringDamper(markerNumbers=markers, **properties))

    def _coordinate(self, body: int, coordinate: int) -> list[int]:
        fixed = self.mbs.AddNode(items.NodePointGround())
        return [
            self.mbs.AddMarker(items.MarkerNodeCoordinate(nodeNumber=node, coordinate=k))
            for node, k in ((fixed, 0), (self.nodes[body], coordinate))
        ]

    def force_sensor(self, joint: int, local: bool) -> int:
        """Add a sensor of the force of a joint; `local`: in the axes of its first marker."""
        kind = exu.OutputVariableType.ForceLocal if local else exu.OutputVariableType.Force
        options: dict[str, Any] = {"storeInternal": True, "writeToFile": False, "outputVariableType": kind}
        return int(self.mbs.AddSensor(items.SensorObject(objectNumber=joint, **options)))

    def hold(self, body: int, coordinate: int) -> None:
        """Keep a coordinate of a body constant."""
        self.mbs.AddObject(items.ObjectConnectorCoordinate(markerNumbers=self._coordinate(body, coordinate)))


def frame(z: ArrayLike) -> Array:
    """Return a rotation matrix with a given last column."""
    z = np.asarray(z, dtype=float)
    x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
