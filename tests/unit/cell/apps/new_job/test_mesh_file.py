"""STEP files, which say their unit: bodies of flat faces, written here from the standard."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from cell.apps.new_job.mesh_file import read_drawing


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
def test_a_step_file_tells_its_unit_and_which_way_is_up(tmp_path: Path, unit: str, metres: float) -> None:
    pytest.importorskip("cascadio")
    path = tmp_path / "box.step"
    path.write_text(step_of(trimesh.creation.box((6.0, 4.0, 1.0)), unit), encoding="utf-8")
    drawn = read_drawing(path)
    assert drawn.unit == "m" and len(drawn.bodies) == 1 and drawn.bodies[0].closed
    np.testing.assert_allclose(drawn.bodies[0].size, metres * np.array([6.0, 4.0, 1.0]), rtol=1e-5)
