"""Links from meshes of uniform density: right for bodies, refused with the reason for what is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from palpate import Arm, Shape
from palpate.errors import InputError
from palpate.identify import mesh_body, printed_complaint, with_meshes

trimesh = pytest.importorskip("trimesh", reason="palpate[cad] is not installed")


def box(
    path: Path, size: tuple[float, float, float], at: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> Path:
    mesh = trimesh.creation.box(extents=size)
    mesh.apply_translation(at)
    mesh.export(path)
    return path


def test_a_box_weighs_what_it_must(tmp_path: Path) -> None:
    size = np.array([100.0, 200.0, 300.0])
    file = box(tmp_path / "box.stl", tuple(size), (10.0, 0.0, -50.0))
    body = mesh_body(file, 2700.0, scale=0.001)
    metres = 1e-3 * size
    assert body.mass == pytest.approx(2700.0 * metres.prod(), rel=1e-6)
    np.testing.assert_allclose(body.com, [0.01, 0.0, -0.05], atol=1e-8)
    x, y, z = metres**2
    np.testing.assert_allclose(
        body.inertia, body.mass / 12.0 * np.diag([y + z, x + z, x + y]), rtol=1e-6, atol=1e-9
    )
    stretched = mesh_body(file, 2700.0, scale=(0.001, 0.002, 0.001))
    assert stretched.mass == pytest.approx(2.0 * body.mass)


def test_what_is_no_body_is_refused_with_the_reason(tmp_path: Path) -> None:
    cube = trimesh.creation.box(extents=(0.1, 0.1, 0.1))
    hole = trimesh.Trimesh(cube.vertices, cube.faces[:-1])
    hole.export(tmp_path / "hole.stl")
    with pytest.raises(InputError, match="hole.stl: is not watertight: 3 of 18 edges"):
        mesh_body(tmp_path / "hole.stl", 1000.0)
    inwards = trimesh.Trimesh(cube.vertices, cube.faces[:, ::-1], process=False)
    inwards.export(tmp_path / "inwards.stl")
    with pytest.raises(InputError, match="face inwards"):
        mesh_body(tmp_path / "inwards.stl", 1000.0)
    with pytest.raises(InputError, match="encloses no volume"):
        mesh_body(box(tmp_path / "small.stl", (1.0, 1.0, 1.0)), 1000.0, scale=1e-6)
    (tmp_path / "text.stl").write_text("solid nothing\nendsolid\n", encoding="utf-8")
    with pytest.raises(InputError, match="text.stl"):
        mesh_body(tmp_path / "text.stl", 1000.0)
    with pytest.raises(InputError, match="no such mesh"):
        mesh_body(tmp_path / "none.stl", 1000.0)
    with pytest.raises(InputError, match="density must be positive"):
        mesh_body(tmp_path / "small.stl", 0.0)


def test_links_as_printed() -> None:
    assert printed_complaint(1.0, np.diag([1.0, 1.0, 1.0])) is None
    assert "triangle inequality" in str(printed_complaint(1.0, np.diag([1.0, 1.0, 3.0])))
    assert "not positive definite" in str(printed_complaint(1.0, np.diag([1.0, -1.0, 1.0])))
    assert "mass must be positive" in str(printed_complaint(0.0, np.eye(3)))
    assert "not symmetric" in str(printed_complaint(1.0, np.eye(3) + np.eye(3, k=1)))
    assert "finite" in str(printed_complaint(1.0, np.full((3, 3), np.nan)))


def drawn(kinds: tuple[str, ...]) -> Arm:
    arm = Arm.from_dh(
        (0.3, 0.2), (0.0, 0.0), (0.0, 0.0), inertials=[(2.0, (0.0, 0.0, 0.0), 0.01 * np.eye(3))] * 2
    )
    T = np.eye(4)
    T[:3, 3] = (0.15, 0.0, 0.0)
    shapes = []
    for link, kind in enumerate(kinds):
        if kind == "mesh":
            shapes.append(Shape("mesh", (1.0, 1.0, 1.0), T, link, filename="package://robot/meshes/link.stl"))
        else:
            shapes.append(Shape("box", (0.3, 0.04, 0.06), T, link))
    return arm.replace(shapes=tuple(shapes))


def test_meshes_become_the_prior(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    box(tmp_path / "meshes" / "link.stl", (0.3, 0.04, 0.06))
    arm, remarks = with_meshes(drawn(("mesh", "box")), tmp_path, density=2000.0)
    assert remarks == ["link link_1: 1.44 kg at 2000 kg/m^3, the arm says 2 kg"] or remarks == []
    first, second = arm.joints
    assert first.mass == pytest.approx(2000.0 * 0.3 * 0.04 * 0.06) == pytest.approx(second.mass)
    np.testing.assert_allclose(first.com, [0.15, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(first.inertia, second.inertia, rtol=1e-6, atol=1e-12)
    same, _ = with_meshes(drawn(("mesh", "box")), tmp_path)
    assert [j.mass for j in same.joints] == pytest.approx([2.0, 2.0])


def test_links_without_a_usable_mesh_keep_what_they_have(tmp_path: Path) -> None:
    start = drawn(("mesh", "box"))
    arm, remarks = with_meshes(start, tmp_path, density=2000.0)
    assert "link link_1 is refused as drawn and keeps its masses: no file is named 'link.stl'" in remarks[0]
    assert arm.joints[0] == start.joints[0] and arm.joints[1] != start.joints[1]
    bare = Arm.from_dh((0.3, 0.2), (0.0, 0.0), (0.0, 0.0))
    with pytest.raises(InputError, match="give the density"):
        with_meshes(bare, tmp_path)
    with pytest.raises(InputError, match="link link_1: it has no shape"):
        with_meshes(bare, tmp_path, density=1000.0)
    with pytest.raises(InputError, match="no folder"):
        with_meshes(start, tmp_path / "none")
