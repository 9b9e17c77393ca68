"""Rounded solids (build123d, in mm) and a glTF writer for make_meshes.py."""

import json
from base64 import b64encode
from collections.abc import Callable, Sequence
from math import cos, pi, sin
from pathlib import Path

import build123d as cad
import numpy as np
from OCP.BRep import BRep_Tool
from OCP.BRepMesh import BRepMesh_IncrementalMesh
from OCP.StdPrs import StdPrs_ToolTriangulatedShape
from OCP.TopAbs import TopAbs_REVERSED
from OCP.TopLoc import TopLoc_Location

Point = tuple[float, float, float]
Circle = tuple[float, float, float]  # two coordinates in the plane normal to the axis, and the radius
Body = list[tuple[str, cad.Shape]]  # solids of a link with the names of their materials

# Base colour (linear red, green, blue), metallic and roughness factors.
MATERIALS: dict[str, tuple[Point, float, float]] = {
    "casting": ((0.235, 0.235, 0.225), 0.0, 0.50),
    "aluminium": ((0.19, 0.20, 0.21), 0.35, 0.32),
    "steel": ((0.11, 0.115, 0.12), 0.45, 0.30),
    "graphite": ((0.045, 0.047, 0.052), 0.10, 0.42),
    "cover": ((0.018, 0.019, 0.022), 0.0, 0.45),
    "anodised": ((0.010, 0.0105, 0.012), 0.15, 0.35),
    "rubber": ((0.012, 0.012, 0.013), 0.0, 0.85),
    "strap": ((0.035, 0.045, 0.075), 0.0, 0.95),
}
LINEAR_TOLERANCE = 1 / 400  # share of a solid's diagonal, limited to FINEST..COARSEST
FINEST, COARSEST = 0.09, 0.25  # mm
ANGULAR_TOLERANCE = 0.60  # radians


def across(axis: str, height: float) -> cad.Plane:
    """Returns a plane normal to an axis. Its axes are the next two in the order x, y, z, x, e.g. (z, x) for "y"."""
    unit = np.eye(3)["xyz".index(axis)]
    return cad.Plane(origin=tuple(unit * height), x_dir=tuple(np.roll(unit, 1)), z_dir=tuple(unit))


def disc(axis: str, low: float, high: float, radius: float, at: Sequence[float] = (0, 0), edge: float = 0) -> cad.Part:
    """Returns a cylinder between two heights on an axis, with rims rounded by the radius `edge`."""
    align = (cad.Align.CENTER, cad.Align.CENTER, cad.Align.MIN)
    solid = across(axis, low) * cad.Pos(*at) * cad.Cylinder(radius, high - low, align=align)
    return cad.fillet(solid.edges().filter_by(cad.GeomType.CIRCLE), edge) if edge else solid


def plate(axis: str, low: float, high: float, circles: Sequence[Circle], edge: float = 0) -> cad.Part:
    """Returns a plate between two heights on an axis: the hull of circles, with rims rounded by the radius `edge`."""
    outlines = [(cad.Pos(u, v) * cad.Circle(radius)).edges() for u, v, radius in circles]
    hull = cad.make_hull([edge for edges in outlines for edge in edges])
    solid = cad.extrude(across(axis, low) * hull, high - low)
    if not edge:
        return solid
    rims = solid.faces().filter_by(getattr(cad.Axis, axis.upper())).edges()
    return cad.fillet(rims, edge)


def swept(path: cad.Edge | cad.Wire, outward: Point, *sections: tuple[float, float, float]) -> cad.Part:
    """Returns the sweep of rounded rectangles along a path. `outward` is the direction of the thickness at the start.

    Each section consists of width, thickness and corner radius. Sections are evenly spaced on the path.
    """
    profiles = []
    for index, (width, thickness, corner) in enumerate(sections):
        location = path.location_at(index / max(1, len(sections) - 1))
        tangent = path.tangent_at(index / max(1, len(sections) - 1))
        direction = np.asarray(outward, dtype=float)
        if index:  # rotate the direction at the start with the tangent
            direction = rotate_with(path.tangent_at(0), tangent, direction)
        sideways = np.cross(direction, tuple(tangent))
        plane = cad.Plane(origin=location.position, x_dir=tuple(sideways), z_dir=tangent)
        profiles.append(plane * cad.RectangleRounded(width, thickness, corner))
    return cad.sweep(profiles if len(profiles) > 1 else profiles[0], path=path, multisection=len(profiles) > 1)


def rotate_with(start: cad.Vector, end: cad.Vector, direction: np.ndarray) -> np.ndarray:
    """Returns `direction` rotated by the smallest rotation from tangent `start` to tangent `end`."""
    a, b = (np.asarray(tuple(vector)) / np.linalg.norm(tuple(vector)) for vector in (start, end))
    normal = np.cross(a, b)
    return direction + np.cross(normal, direction) + np.cross(normal, np.cross(normal, direction)) / (1 + a @ b)


def bolts(
    axis: str,
    low: float,
    high: float,
    circle: float,
    count: int,
    radius: float,
    at: Sequence[float] = (0, 0),
    phase: float = 0.5,
) -> list[cad.Part]:
    """Returns screw heads on a circle. `phase` is the position of the first screw as a share of the spacing."""
    angles = [2 * pi * (index + phase) / count for index in range(count)]
    places = [(at[0] + circle * cos(angle), at[1] + circle * sin(angle)) for angle in angles]
    return [disc(axis, low, high, radius, place) for place in places]


def both(make: Callable[[float], Sequence[cad.Shape] | cad.Shape]) -> list[cad.Shape]:
    """Returns the results of `make` for both sides of the plane x = 0, +1 and -1."""
    made = [make(side) for side in (1.0, -1.0)]
    return [part for one in made for part in (one if isinstance(one, list) else [one])]


def moved(body: Body, by: Sequence[float]) -> Body:
    """Returns the body translated by a vector."""
    return [(material, cad.Pos(*by) * solid) for material, solid in body]


def made_of(material: str, *solids: cad.Shape | Sequence[cad.Shape]) -> Body:
    """Returns a body of these solids in one material."""
    flat = [part for solid in solids for part in (solid if isinstance(solid, list) else [solid])]
    return [(material, part) for part in flat]


def fused(material: str, *solids: cad.Shape) -> Body:
    """Returns the union of the solids in one material.

    Raises:
        ValueError: The CAD kernel lost a solid. The kernel loses solids without an error if faces almost coincide. Move
            the faces apart.
    """
    union = solids[0].fuse(*solids[1:])
    bounds, expected = union.bounding_box(), cad.Compound(children=list(solids)).bounding_box()
    if (bounds.min - expected.min).length > 1e-3 or (bounds.max - expected.max).length > 1e-3:
        raise ValueError(
            f"The union lost a solid: its bounding box is {bounds} instead of {expected}. Move the faces apart."
        )
    return [(material, union)]


def triangulated(solid: cad.Shape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns vertices, exact unit normals, and triangles. Faces share no vertices, so edges are sharp."""
    tolerance = min(COARSEST, max(FINEST, LINEAR_TOLERANCE * solid.bounding_box().diagonal))
    BRepMesh_IncrementalMesh(solid.wrapped, tolerance, False, ANGULAR_TOLERANCE, False)
    points, normals, triangles, count = [], [], [], 0
    for face in solid.faces():
        location = TopLoc_Location()
        mesh = BRep_Tool.Triangulation_s(face.wrapped, location)
        StdPrs_ToolTriangulatedShape.ComputeNormals_s(face.wrapped, mesh)
        move = location.Transformation()
        reverse = face.wrapped.Orientation() == TopAbs_REVERSED
        for node in range(1, mesh.NbNodes() + 1):
            point, normal = mesh.Node(node).Transformed(move), mesh.Normal(node).Transformed(move)
            points.append(point.Coord())
            normals.append((normal.Reversed() if reverse else normal).Coord())
        for index in range(1, mesh.NbTriangles() + 1):
            a, b, c = mesh.Triangle(index).Get()
            triangles.append(
                (count + a - 1, count + c - 1, count + b - 1)
                if reverse
                else (count + a - 1, count + b - 1, count + c - 1)
            )
        count += mesh.NbNodes()
    return np.array(points), np.array(normals), np.array(triangles)


def joined(solids: Sequence[cad.Shape]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the vertices, normals and triangles of several solids."""
    parts = [triangulated(solid) for solid in solids]
    first = np.cumsum([0] + [len(points) for points, _, _ in parts])
    triangles = [triangles + start for (_, _, triangles), start in zip(parts, first, strict=False)]
    return np.vstack([p for p, _, _ in parts]), np.vstack([n for _, n, _ in parts]), np.vstack(triangles)


def write_gltf(body: Body, path: Path) -> None:
    """Writes a body to a glTF file, in metres and with Y up, as the format requires. Drake rotates it to Z up."""
    data, views, accessors, meshes, materials = bytearray(), [], [], [], []
    for name in dict.fromkeys(material for material, _ in body):
        points, normals, triangles = joined([solid for material, solid in body if material == name])
        y_up = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
        points = (points / 1000 @ y_up.T).round(6).astype("<f4")
        index_type, index_code = ("<u2", 5123) if len(points) < 65535 else ("<u4", 5125)
        bounds = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
        first = len(accessors)
        for array, kind, code, target, extra in (
            (points, "VEC3", 5126, 34962, bounds),
            ((normals @ y_up.T).round(4).astype("<f4"), "VEC3", 5126, 34962, {}),
            (triangles.astype(index_type).ravel(), "SCALAR", index_code, 34963, {}),
        ):
            content = array.tobytes()
            views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(content), "target": target})
            accessors.append(
                {
                    "bufferView": len(views) - 1,
                    "componentType": code,
                    "count": len(array),
                    "type": kind,
                    **extra,
                }
            )
            data += content + b"\0" * (-len(content) % 4)
        attributes = {"POSITION": first, "NORMAL": first + 1}
        meshes.append(
            {
                "name": name,
                "primitives": [{"attributes": attributes, "indices": first + 2, "material": len(materials)}],
            }
        )
        colour, metallic, roughness = MATERIALS[name]
        materials.append(
            {
                "name": name,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*colour, 1],
                    "metallicFactor": metallic,
                    "roughnessFactor": roughness,
                },
            }
        )
    uri = "data:application/octet-stream;base64," + b64encode(data).decode()
    document = {
        "asset": {"version": "2.0", "generator": "tools/make_meshes.py"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"name": mesh["name"], "mesh": index} for index, mesh in enumerate(meshes)],
        "meshes": meshes,
        "materials": materials,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data), "uri": uri}],
    }
    path.write_text(json.dumps(document, separators=(",", ":")) + "\n")
