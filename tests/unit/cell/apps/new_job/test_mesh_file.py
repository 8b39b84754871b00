"""Promises of `cell.apps.new_job.mesh_file`; the STEP files are written here from the standard."""

import numpy as np
import pytest
import trimesh

from cell.apps.new_job.mesh_file import read_drawing
from drivers.errors import ConfigError


def step_of(box: trimesh.Trimesh, unit: str) -> str:
    """A body of flat faces as a STEP file (ISO 10303-21, AP214), its numbers in mm or inch."""
    lines: list[str] = []

    def add(text: str) -> str:
        lines.append(f"#{len(lines) + 1}={text};")
        return f"#{len(lines)}"

    app = add("APPLICATION_CONTEXT('automotive design')")
    about = add(f"PRODUCT_CONTEXT('',{app},'mechanical')")
    made = add(f"PRODUCT('box','box','',({about}))")
    form = add(f"PRODUCT_DEFINITION_FORMATION('','',{made})")
    stage = add(f"PRODUCT_DEFINITION_CONTEXT('part definition',{app},'design')")
    seen = add(f"PRODUCT_DEFINITION('','',{form},{stage})")
    shape = add(f"PRODUCT_DEFINITION_SHAPE('','',{seen})")
    metre = add("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
    if unit == "inch":
        size = add(f"LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),{metre})")
        powers = add("DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.)")
        metre = add(f"(CONVERSION_BASED_UNIT('INCH',{size})LENGTH_UNIT()NAMED_UNIT({powers}))")
    angle = add("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
    solid = add("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
    units = f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({metre},{angle},{solid}))"
    context = add(f"(GEOMETRIC_REPRESENTATION_CONTEXT(3){units}REPRESENTATION_CONTEXT('',''))")
    corners = [add(f"CARTESIAN_POINT('',({x:.6f},{y:.6f},{z:.6f}))") for x, y, z in box.vertices]
    faces = []
    for face, normal in zip(box.faces, box.face_normals, strict=True):
        loop = add(f"POLY_LOOP('',({','.join(corners[k] for k in face)}))")
        bound = add(f"FACE_OUTER_BOUND('',{loop},.T.)")
        ways = [np.roll(normal, 1), normal]
        along, up = (add(f"DIRECTION('',({','.join(f'{v:.6f}' for v in way)}))") for way in ways)
        there = add(f"AXIS2_PLACEMENT_3D('',{corners[face[0]]},{up},{along})")
        plane = add(f"PLANE('',{there})")
        faces.append(add(f"FACE_SURFACE('',({bound}),{plane},.T.)"))
    shell = add(f"CLOSED_SHELL('',({','.join(faces)}))")
    brep = add(f"FACETED_BREP('',{shell})")
    drawn = add(f"FACETED_BREP_SHAPE_REPRESENTATION('',({brep}),{context})")
    add(f"SHAPE_DEFINITION_REPRESENTATION({shape},{drawn})")
    head = "HEADER;\nFILE_DESCRIPTION((''),'2;1');\nFILE_NAME('','',(''),(''),'','','');\n"
    head += "FILE_SCHEMA(('AUTOMOTIVE_DESIGN'));\nENDSEC;\n"
    return f"ISO-10303-21;\n{head}DATA;\n" + "\n".join(lines) + "\nENDSEC;\nEND-ISO-10303-21;\n"


@pytest.mark.parametrize(("unit", "metres"), [("mm", 1e-3), ("inch", 0.0254)])
def test_a_step_file_tells_its_unit_and_which_way_is_up(tmp_path, unit: str, metres: float):
    pytest.importorskip("cascadio")
    path = tmp_path / "box.step"
    path.write_text(step_of(trimesh.creation.box((6.0, 4.0, 1.0)), unit), encoding="utf-8")
    drawn = read_drawing(path)
    assert drawn.unit == "m" and len(drawn.bodies) == 1 and drawn.bodies[0].closed
    np.testing.assert_allclose(drawn.bodies[0].size, metres * np.array([6.0, 4.0, 1.0]), rtol=1e-5)


def test_what_is_wrong_with_a_mesh_is_named_and_put_right(tmp_path):
    inside_out, turned, lone = (trimesh.creation.box((20.0, 10.0, 5.0)) for _ in range(3))
    inside_out.invert()
    faces = turned.faces.copy()
    faces[3] = faces[3][::-1]
    turned = trimesh.Trimesh(turned.vertices + np.array([40.0, 0.0, 0.0]), faces, process=False)
    lone = trimesh.Trimesh(lone.vertices + np.array([80.0, 0.0, 0.0]), lone.faces[1:], process=False)
    flat = trimesh.Trimesh(np.array([[0, 0, 9], [1, 0, 9], [2, 0, 9]], dtype=float), [[0, 1, 2]], process=False)
    path = tmp_path / "parts.stl"
    trimesh.util.concatenate([inside_out, turned, lone, flat]).export(path)
    drawn = read_drawing(path)
    assert len(drawn.bodies) == 3 and drawn.unit is None
    assert sorted(body.closed for body in drawn.bodies) == [False, True, True]
    told = "\n".join(drawn.notes)
    for words in (
        "1 triangles without an area",
        "12 triangles turned round",
        "\n1 triangles turned round",
        "open: 3 edges",
    ):
        assert words in told, told
    for body in drawn.bodies:
        if body.closed:
            made = trimesh.Trimesh(body.vertices, body.triangles, process=False)
            assert made.volume == pytest.approx(1000.0)


@pytest.mark.parametrize(
    ("corner", "far"), [(99, 1.0), (-3, 1.0), (2, 1e200)], ids=["one too many", "one from the end", "far away"]
)
def test_a_mesh_with_corners_that_it_cannot_have_is_refused(tmp_path, corner: int, far: float):
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty double x\nproperty double y\nproperty double z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "one.ply").write_text(f"{head}0 0 0\n1 0 0\n0 {far} 0\n3 0 1 {corner}\n")
    with pytest.raises(ConfigError, match="names corners that it does not have"):
        read_drawing(tmp_path / "one.ply")
