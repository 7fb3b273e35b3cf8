"""Links from their drawings: mass, centre of mass and inertia of meshes of uniform density, as a prior "
"for a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from palpate.arm import Arm, Array, Shape, inertia_complaint
from palpate.errors import InputError, MissingExtraError

LEAST_VOLUME = 1e-12
"""[m^3]; a cube of a tenth of a millimetre"""


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A rigid body in some frame.

    Attributes:
        mass: [kg].
        com: (3,) centre of mass [m].
        inertia: (3, 3) about the centre of mass, axes of the frame [kg m^2].
        volume: [m^3].
    """

    mass: float
    com: Array
    inertia: Array
    volume: float


def mesh_body(
    path: str | PathLike[str], density: float, *, scale: float | tuple[float, float, float] = 1.0
) -> Body:
    """The body that fills a mesh evenly.

    Args:
        path: STL, OBJ, PLY, ...: whatever trimesh reads.
        density: [kg/m^3].
        scale: of the file's lengths to m, along its axes; 0.001 for a drawing in mm.

    Raises:
        InputError: the file cannot be read, or no body can have this surface: it has holes, encloses nothing,
            faces inwards, or its inertia breaks the triangle inequality; the message says which.
        MissingExtraError: without the extra ``cad``.
    """
    try:
        import trimesh
    except ImportError:
        raise MissingExtraError("cad", "reading a mesh") from None
    if not (math.isfinite(density) and density > 0.0):
        raise InputError(f"density must be positive [kg/m^3], got {density!r}")
    file = Path(path)
    if not file.is_file():
        raise InputError(f"{file}: no such mesh")
    try:
        mesh = trimesh.load_mesh(file, process=True)
    except Exception as error:  # noqa: BLE001 trimesh's readers raise whatever their format's parser does
        raise InputError(f"{file.name}: cannot be read: {' '.join(str(error).split())[:200]}") from None
    mesh = mesh.copy()
    mesh.apply_transform(np.diag([*np.broadcast_to(np.asarray(scale, dtype=np.float64), (3,)), 1.0]))
    return _body_of(mesh, density, file.name)


def _body_of(mesh: object, density: float, name: str) -> Body:
    """What fills a trimesh, after a look whether anything can."""
    from trimesh import Trimesh

    if not isinstance(mesh, Trimesh) or len(mesh.faces) == 0:
        raise InputError(f"{name}: holds no triangles")
    if not np.all(np.isfinite(mesh.vertices)):
        raise InputError(f"{name}: has vertices that are not finite")
    if not mesh.is_watertight:
        counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
        raise InputError(
            f"{name}: is not watertight: {np.count_nonzero(counts != 2)} of {len(counts)} edges do not "
            "belong to "
            "exactly two triangles, so it has no inside; close its holes"
        )
    if not mesh.is_winding_consistent:
        raise InputError(f"{name}: its triangles face in and out by turns, so it has no inside")
    volume = float(mesh.volume)
    if volume < -LEAST_VOLUME:
        raise InputError(f"{name}: its triangles face inwards (volume {volume:.3g} m^3); turn them round")
    if volume < LEAST_VOLUME:
        raise InputError(
            f"{name}: encloses no volume ({volume:.3g} m^3): a flat sheet, or lengths in another unit?"
        )
    mesh.density = density
    inertia = np.asarray(mesh.moment_inertia, dtype=np.float64)
    inertia = 0.5 * (inertia + inertia.T)
    complaint = inertia_complaint(inertia)
    if complaint:
        raise InputError(f"{name}: {complaint}")
    return Body(float(mesh.mass), np.asarray(mesh.center_mass, dtype=np.float64), inertia, volume)


def printed_complaint(mass: float, inertia: Array) -> str | None:
    """Why a link as printed in a table or a file can be no body; None if it can.

    Args:
        mass: [kg].
        inertia: (3, 3) about the centre of mass [kg m^2].
    """
    if not (math.isfinite(mass) and mass > 0.0):
        return f"mass must be positive, got {mass!r}"
    tensor = np.asarray(inertia, dtype=np.float64)
    if tensor.shape != (3, 3) or not np.all(np.isfinite(tensor)):
        return f"inertia must be (3, 3) finite numbers, got {tensor.tolist()}"
    if np.any(np.abs(tensor - tensor.T) > 1e-6 * np.abs(tensor).max()):
        return f"inertia is not symmetric: {tensor.tolist()}"
    return inertia_complaint(tensor)


def with_meshes(
    arm: Arm, folder: str | PathLike[str], *, density: float | None = None
) -> tuple[Arm, list[str]]:
    """The arm with links of uniform density inside their shapes, as the prior of a fit.

    Every shape of a link counts: its meshes, found in the folder by the end of the file name the URDF gives, and
    its boxes, cylinders, spheres and capsules. A link none of whose shapes can be a body keeps what it has.

    Args:
        arm: with shapes.
        folder: where the meshes are.
        density: [kg/m^3]; None: of each link so that its mass is the arm's.

    Returns:
        the arm, and a sentence for every link that was refused or changed much.

    Raises:
        InputError: no density and the arm has no masses; no folder; a link without masses has no usable shape.
        MissingExtraError: without the extra ``cad``.
    """
    if density is None and not arm.has_dynamics:
        raise InputError(f"arm {arm.name!r} has no masses: give the density of its links [kg/m^3]")
    root = Path(folder)
    if not root.is_dir():
        raise InputError(f"{root}: no folder with meshes")
    joints, remarks = [], []
    for i, joint in enumerate(arm.joints):
        try:
            body = _link_body([s for s in arm.shapes if s.link == i], root, density or 1.0)
        except InputError as error:
            if not arm.has_dynamics:
                raise InputError(f"link {joint.link}: {error}") from None
            remarks.append(f"link {joint.link} is refused as drawn and keeps its masses: {error}")
            joints.append(joint)
            continue
        factor = 1.0 if density is not None else joint.mass / body.mass
        mass = body.mass * factor
        if density is not None and joint.mass > 0.0 and not 0.5 < mass / joint.mass < 2.0:
            remarks.append(
                f"link {joint.link}: {mass:.3g} kg at {density:g} kg/m^3, the arm says {joint.mass:.3g} kg"
            )
        joints.append(joint.replace(mass=mass, com=body.com, inertia=body.inertia * factor))
    return arm.replace(joints=tuple(joints)), remarks


def _link_body(shapes: list[Shape], root: Path, density: float) -> Body:
    """The shapes of a link as one body in the link's frame."""
    if not shapes:
        raise InputError("it has no shape")
    parts = []
    for shape in shapes:
        part = _shape_body(shape, root, density)
        R, p = shape.T[:3, :3], shape.T[:3, 3]
        parts.append(Body(part.mass, R @ part.com + p, R @ part.inertia @ R.T, part.volume))
    mass = sum(b.mass for b in parts)
    com = sum((b.mass * b.com for b in parts), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for b in parts:
        d = b.com - com
        inertia += b.inertia + b.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Body(mass, com, inertia, sum(b.volume for b in parts))


def _shape_body(shape: Shape, root: Path, density: float) -> Body:
    try:
        from trimesh import creation
    except ImportError:
        raise MissingExtraError("cad", "a link from its shapes") from None
    if shape.kind == "mesh":
        return mesh_body(_find(shape.filename or "", root), density, scale=shape.size)  # type: ignore[arg-type]
    if min(shape.size) <= 0.0:
        raise InputError(f"a {shape.kind} of size {shape.size} encloses no volume")
    if shape.kind == "box":
        mesh = creation.box(extents=shape.size)
    elif shape.kind == "sphere":
        mesh = creation.icosphere(subdivisions=4, radius=shape.size[0])
    else:
        make = creation.cylinder if shape.kind == "cylinder" else creation.capsule
        mesh = make(radius=shape.size[0], height=shape.size[1])
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return _body_of(mesh, density, f"a {shape.kind}")


def _find(name: str, root: Path) -> Path:
    """The file in the folder that shares the longest end of its path with the name.

    Raises:
        InputError: none is there.
    """
    parts = [p for p in name.replace("\\", "/").split("://")[-1].split("/") if p not in ("", ".", "..")]
    for k in range(len(parts)):
        candidate = root.joinpath(*parts[k:])
        if candidate.is_file():
            return candidate
    found = sorted(root.rglob(parts[-1])) if parts else []
    if len(found) == 1:
        return found[0]
    raise InputError(
        f"{'several files are' if found else 'no file is'} named {parts[-1] if parts else name!r} in {root}"
    )
