"""Units that mesh files state."""

from __future__ import annotations

import base64
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from impact_posture.collision.robot_shapes import load_shapes
from impact_posture.output.report.drawn_robot import draw_robot
from impact_posture.system.arrays import Array
from tests.support.urdfs import joint, link, load

# A box of 1 × 2 × 3 units.
CORNERS = [(x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 3)]
FACES = [
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
]  # fmt: skip
POINTS = " ".join(f"{x} {y} {z}" for x, y, z in CORNERS)


def collada(asset: str, node: str = "") -> str:
    return (
        f'<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>{asset}</asset>'
        '<library_geometries><geometry id="g"><mesh><source id="p">'
        f'<float_array id="a" count="24">{POINTS}</float_array><technique_common>'
        '<accessor source="#a" count="8" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>'
        '<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v">'
        '<input semantic="POSITION" source="#p"/></vertices><triangles count="12">'
        f'<input semantic="VERTEX" source="#v" offset="0"/><p>{" ".join(str(k) for face in FACES for k in face)}</p>'
        '</triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="s">'
        f'<node id="n">{node}<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>'
        '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'
    )


def amf(unit: str) -> str:
    vertices = (f"<vertex><coordinates><x>{x}</x><y>{y}</y><z>{z}</z></coordinates></vertex>" for x, y, z in CORNERS)
    triangles = (f"<triangle><v1>{a}</v1><v2>{b}</v2><v3>{c}</v3></triangle>" for a, b, c in FACES)
    volume = f"<vertices>{''.join(vertices)}</vertices><volume>{''.join(triangles)}</volume>"
    return f'<amf{unit}><object id="0"><mesh>{volume}</mesh></object></amf>'


def x3d(unit: str) -> str:
    index = " -1 ".join(f"{a} {b} {c}" for a, b, c in FACES)
    shape = f'<Shape><IndexedFaceSet coordIndex="{index} -1"><Coordinate point="{POINTS}"/></IndexedFaceSet></Shape>'
    return f'<X3D profile="Interchange" version="3.3"><head>{unit}</head><Scene>{shape}</Scene></X3D>'


def write_3mf(path: Path, unit: str) -> None:
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in CORNERS)
    triangles = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in FACES)
    mesh = f"<mesh><vertices>{vertices}</vertices><triangles>{triangles}</triangles></mesh>"
    package, material = (
        "http://schemas.openxmlformats.org/package/2006",
        "http://schemas.microsoft.com/3dmanufacturing",
    )
    files = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types"><Default Extension="model" '
        'ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/></Types>',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships">'
        f'<Relationship Target="/3D/3dmodel.model" Id="r" Type="{material}/2013/01/3dmodel"/></Relationships>',
        "3D/3dmodel.model": f'<model{unit} xmlns="{material}/core/2015/02"><resources>'
        f'<object id="1" type="model">{mesh}</object></resources><build><item objectid="1"/></build></model>',
    }
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, f'<?xml version="1.0"?>{text}')


def write_gltf(path: Path, root: dict[str, object]) -> None:
    """Write the box as a child of a root node; the suffix chooses the text or the binary form."""
    data = np.array(CORNERS, "<f4").tobytes() + np.array(FACES, "<u2").tobytes()
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], **root}, {"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": 96},
            {"buffer": 0, "byteOffset": 96, "byteLength": len(data) - 96},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3", "min": [0, 0, 0], "max": [1, 2, 3]},
            {"bufferView": 1, "componentType": 5123, "count": 36, "type": "SCALAR"},
        ],
    }
    if path.suffix == ".gltf":
        content["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        path.write_text(json.dumps(content))
        return
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def extents(folder: Path, mesh: str, scale: str = "") -> tuple[Array, tuple[str, ...]]:
    """Return the edge lengths of a collision mesh, m, and the warnings; check that the drawn mesh agrees."""
    described = f'<geometry><mesh filename="{mesh}"{scale}/></geometry>'
    tags = f"<collision>{described}</collision><visual>{described}</visual>"
    robot = load(folder, link("a"), link("b", 1, more=tags), joint("j", "a b"), armature="none")
    shapes = load_shapes(robot)
    if not shapes.bodies:
        return np.zeros(3), shapes.warnings
    edges = np.ptp(shapes.bodies[0].vertices, axis=0)
    # The corners of drawn meshes are rounded.
    np.testing.assert_allclose(np.ptp(draw_robot(robot, meshes=True).solids[0].points, axis=0), edges, rtol=1e-4)
    return edges, shapes.warnings


@pytest.mark.parametrize(
    ("asset", "node", "scale", "size"),
    [
        ("", "", "", (1, 2, 3)),
        ('<unit meter="1" name="meter"/><up_axis>Z_UP</up_axis>', "", "", (1, 2, 3)),
        ('<unit name="cm" meter="0.01"/><up_axis>Z_UP</up_axis>', "", "", (0.01, 0.02, 0.03)),
        ("<unit name='inch' meter = '2.54e-2'/>", "", "", (0.0254, 0.0508, 0.0762)),
        ('<unit meter="0.01"/>', "", ' scale="10 -1 0.5"', (0.1, 0.02, 0.015)),
        ('<unit meter="0.01"/>', "<translate>7 0 0</translate><scale>2 2 1</scale>", "", (0.02, 0.04, 0.03)),
        # As RViz and Gazebo do, leave a mesh as it is if it states another up axis.
        ('<unit meter="0.01"/><up_axis>Y_UP</up_axis>', "", "", (0.01, 0.02, 0.03)),
        ('<unit meter="0"/>', "", "", (1, 2, 3)),
        ('<unit meter="one"/>', "", "", (1, 2, 3)),
    ],
)
def test_the_unit_of_a_collada_file_applies(
    tmp_path: Path, asset: str, node: str, scale: str, size: tuple[float, ...]
) -> None:
    (tmp_path / "box.dae").write_text(collada(asset, node))
    edges, warnings = extents(tmp_path, "box.dae", scale)
    np.testing.assert_allclose(edges, size, rtol=1e-6)
    assert not warnings


@pytest.mark.parametrize(("unit", "factor"), [("millimeter", 1e-3), ("inch", 0.0254), ("meter", 1.0), ("", 1.0)])
def test_the_units_of_other_formats_apply(tmp_path: Path, unit: str, factor: float) -> None:
    attribute = f' unit="{unit}"' if unit else ""
    (tmp_path / "box.amf").write_text(amf(attribute))
    write_3mf(tmp_path / "box.3mf", attribute)
    conversion = f"<unit name='u' category='length' conversionFactor='{factor}'/>" if unit else ""
    angle = "<unit category='angle' conversionFactor='0.5'/>"
    (tmp_path / "box.x3d").write_text(x3d(angle + conversion))
    for name in ("box.amf", "box.3mf", "box.x3d"):
        edges, warnings = extents(tmp_path, name)
        np.testing.assert_allclose(edges, factor * np.array([1, 2, 3]), rtol=1e-6)
        assert not warnings


@pytest.mark.parametrize("name", ["box.gltf", "box.glb"])
@pytest.mark.parametrize(
    ("root", "size"),
    [
        ({}, (1, 2, 3)),
        ({"rotation": [0.7071068, 0, 0, 0.7071068]}, (1, 3, 2)),
        ({"rotation": [0, 0, 0.7071068, 0.7071068], "scale": [1, 2, 0.1], "translation": [9, 0, 0]}, (4, 1, 0.3)),
        ({"matrix": [0, 0.1, 0, 0, 0.1, 0, 0, 0, 0, 0, 0.1, 0, 5, 0, 0, 1]}, (0.2, 0.1, 0.3)),
    ],
)
def test_the_root_of_a_gltf_file_applies(
    tmp_path: Path, name: str, root: dict[str, object], size: tuple[float, ...]
) -> None:
    """coal leaves out the transform of the root node, which exporters use to turn y up into z up."""
    write_gltf(tmp_path / name, root)
    edges, warnings = extents(tmp_path, name, ' scale="0.1 -0.1 0.2"')
    np.testing.assert_allclose(edges, np.array(size) * [0.1, 0.1, 0.2], rtol=1e-5)
    assert not warnings


@pytest.mark.parametrize(
    ("unit", "words"),
    [("1", "60 m large, so it is not in meters; "), ("0.5", "30 m large with the unit of 0.5 m that it states, so ")],
)
def test_a_mesh_that_is_too_large_states_its_unit(tmp_path: Path, unit: str, words: str) -> None:
    (tmp_path / "box.dae").write_text(collada(f'<unit meter="{unit}"/>'))
    _, warnings = extents(tmp_path, "box.dae", ' scale="20 20 20"')
    assert any(words in line and "give its <mesh> a scale" in line for line in warnings)


def test_a_damaged_archive_is_left_out(tmp_path: Path) -> None:
    write_3mf(tmp_path / "box.3mf", "")
    (tmp_path / "box.3mf").write_bytes((tmp_path / "box.3mf").read_bytes()[:-30])
    _, warnings = extents(tmp_path, "box.3mf")
    assert any("cannot be read as a mesh, or is empty" in line for line in warnings)
