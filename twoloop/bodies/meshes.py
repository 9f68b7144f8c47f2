"""Read triangle meshes (STL, OBJ, MSH, vertices in the file) and compute their masses.

As in MuJoCo, vertices without faces stand for their convex hull.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from twoloop.bodies.file_parts import Lump, Pose, numbers, pose_of, principal_axes
from twoloop.checks.arguments import Array

PRODUCTS = 1e-7  # MuJoCo neglects products of inertia up to this fraction of the largest entry in a mesh's frame
STL_HEAD, MSH_HEAD = 84, 16  # bytes before the triangles of an STL file, and before the numbers of an MSH file


def mesh_triangles(given: Mapping[str, str], folder: Path, what: str) -> Array | None:
    """Return the triangles (n, 3, 3) of a mesh asset in m, or None if it cannot be read."""
    if "vertex" in given:
        vertices = _real(given["vertex"]).reshape(-1, 3)
        faces = _real(given["face"]).astype(int).reshape(-1, 3) if "face" in given else None
    elif "file" in given:
        path = folder / given["file"]
        if not path.is_file():
            return None
        reader = {".stl": _stl, ".obj": _obj, ".msh": _msh}.get(path.suffix.lower())
        content = None if reader is None else reader(path)
        if content is None:
            return None
        vertices, faces = content
    else:
        return None
    vertices = vertices.astype(np.float32).astype(float)  # as MuJoCo stores them
    if "refpos" in given or "refquat" in given:
        reference = {"pos": given.get("refpos", "0 0 0"), "quat": given.get("refquat", "1 0 0 0")}
        pose = pose_of(reference, what, True, "xyz")
        vertices = (vertices - pose.x) @ pose.R
    scale = numbers(given.get("scale", "1 1 1"), 3, f"scale of {what}")
    vertices = vertices * scale
    if faces is None or given.get("inertia", "legacy") == "convex":
        return _hull(vertices)
    return np.asarray(vertices[faces if scale.prod() > 0.0 else faces[:, ::-1]])  # a mirror turns triangles inside out


def mesh_lump(triangles: Array, inertia: str) -> Lump:
    """Return the mass of density 1 within triangles, or on them with the inertia "shell".

    "legacy", MuJoCo's default: pyramids from the centroid of the surface to the triangles are added up with positive
    volumes, which is exact for convex meshes and yields the centre; mass and inertia are sums over pyramids from this
    centre.
    """
    areas = 0.5 * np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    origin, shell = (areas @ triangles.mean(axis=1)) / areas.sum(), inertia == "shell"
    for repeated in (False, True):
        corners = triangles - origin
        volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
        volumes = areas if shell else np.abs(volumes) if inertia == "legacy" else volumes
        volume, sums = float(volumes.sum()), corners.sum(axis=1)
        if not volume > 0.0:
            return Lump(0.0, np.zeros(3), np.zeros((3, 3)))
        # integral of x x^T, with corners c and their sum s: volume / 20 (sum of c c^T + s s^T) over a tetrahedron with
        # a corner at the origin; area / 12 (sum of c c^T + s s^T) over a triangle
        second = np.einsum("i,ijk,ijl->kl", volumes, corners, corners) + np.einsum("i,ik,il->kl", volumes, sums, sums)
        if not (repeated or shell):
            origin = origin + volumes @ sums / (4.0 * volume)
    second = second / (12.0 if shell else 20.0)
    J = np.trace(second) * np.eye(3) - second
    axes = principal_axes(J, PRODUCTS)
    return Lump(volume, origin, axes @ np.diag(np.diag(axes.T @ J @ axes)) @ axes.T, axes)


def fitted(triangles: Array, inertia: str, kind: str, by_box: bool) -> tuple[Array, Pose]:
    """Return size and pose of a geom that is fitted to a mesh, by its moments of inertia or by its bounding box."""
    lump = mesh_lump(triangles, inertia)
    assert lump.axes is not None
    moments = np.diag(lump.axes.T @ lump.J @ lump.axes) / lump.mass
    order = np.argsort(-moments)
    moments, axes = moments[order], lump.axes[:, order]
    axes = axes * np.array([1.0, 1.0, np.sign(np.linalg.det(axes))])
    pose = Pose(lump.centre, axes)
    half = np.sqrt(np.maximum(1.5 * (moments.sum() - 2.0 * moments), 0.0))
    if by_box:
        local = (triangles.reshape(-1, 3) - lump.centre) @ axes
        low, high = local.min(axis=0), local.max(axis=0)
        half, pose = 0.5 * (high - low), Pose(pose.point(0.5 * (low + high)), axes)
    radius = float(half[:2].max() if by_box else half[:2].mean())
    sizes = {
        "sphere": np.array([half.max() if by_box else half.mean()]),
        "capsule": np.array([radius, half[2] - (radius if by_box else 0.5 * radius)]),
        "cylinder": np.array([radius, half[2]]),
        "box": half,
        "ellipsoid": half,
    }
    return sizes[kind], pose


def _real(text: str) -> Array:
    return np.array([float(each) for each in text.split()])


def _hull(vertices: Array) -> Array | None:
    from scipy.spatial import ConvexHull, QhullError  # slow to import, and rarely needed

    try:
        hull = ConvexHull(vertices)
    except (QhullError, ValueError):
        return None
    triangles, outward = vertices[hull.simplices], hull.equations[:, :3]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inverted = np.einsum("ij,ij->i", normals, outward) < 0.0
    triangles[inverted] = triangles[inverted][:, ::-1]
    return np.asarray(triangles)


def _stl(path: Path) -> tuple[Array, Any] | None:
    """Read a binary STL file; like MuJoCo, do not read STL files in text form."""
    data = path.read_bytes()
    n = int.from_bytes(data[STL_HEAD - 4 : STL_HEAD], "little") if len(data) >= STL_HEAD else 0
    if n == 0 or len(data) < STL_HEAD + 50 * n:
        return None
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    corners = np.frombuffer(data, record, n, STL_HEAD)["corners"].astype(float)
    return corners.reshape(-1, 3), np.arange(3 * n).reshape(n, 3)


def _obj(path: Path) -> tuple[Array, Any] | None:
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for line in path.read_text(errors="replace").splitlines():
        tag, *words = line.split() or [""]
        if tag == "v":
            vertices.append([float(each) for each in words[:3]])
        elif tag == "f":
            corners = [int(each.split("/")[0]) for each in words]
            polygons.append([each - 1 if each > 0 else len(vertices) + each for each in corners])
    points, faces = np.array(vertices), list[list[int]]()
    for each in polygons:
        faces += [each] if len(each) == 3 else [[each[k] for k in triple] for triple in _triangles(points[each])]
    return (points, np.array(faces) if faces else None) if vertices else None


def _triangles(points: Array) -> list[list[int]]:
    """Cut a polygon into triangles: one of four corners along its shorter diagonal, as MuJoCo does, else ear by ear."""
    left, triangles = list(range(len(points))), list[list[int]]()
    if len(left) == 4:
        across = np.linalg.norm((points[2:] - points[:2]).astype(np.float32), axis=1)
        return [[0, 1, 2], [0, 2, 3]] if across[0] < across[1] else [[0, 1, 3], [1, 2, 3]]
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    while len(left) > 3:
        for k in range(len(left)):
            ear = [left[k - 1], left[k], left[(k + 1) % len(left)]]
            edges = np.roll(points[ear], -1, axis=0) - points[ear]
            sides = np.cross(edges, points[[each for each in left if each not in ear], None] - points[ear]) @ normal
            if np.cross(edges[0], edges[1]) @ normal > 0.0 and not (sides >= 0.0).all(axis=1).any():
                break
        triangles.append(ear)
        left.remove(ear[1])
    return [*triangles, left] if left[2:] else triangles


def _msh(path: Path) -> tuple[Array, Any] | None:
    """Read MuJoCo's own format: the numbers of vertices, normals, texture coordinates and faces, then their values."""
    data = path.read_bytes()
    if len(data) < MSH_HEAD:
        return None
    n, n_normals, n_textures, n_faces = np.frombuffer(data, "<i4", 4).tolist()
    needed = MSH_HEAD + 4 * (3 * n + 3 * n_normals + 2 * n_textures + 3 * n_faces)
    if min(n, n_normals, n_textures, n_faces) < 0 or len(data) != needed:
        return None
    vertices = np.frombuffer(data, "<f4", 3 * n, MSH_HEAD).astype(float).reshape(n, 3)
    faces = np.frombuffer(data, "<i4", 3 * n_faces, needed - 12 * n_faces).reshape(n_faces, 3)
    return vertices, faces if n_faces else None
