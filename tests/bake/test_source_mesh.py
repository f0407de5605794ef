"""Mesh files: positions, albedo and emission to the letter of the contract; broken files in one line."""

import base64
import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from bake_jobs.mesh_source import DEFAULT_ALBEDO
from bake_jobs.scene_source import load_scene
from bake_jobs.texture_mean import linear_from_srgb, mean_over_triangles
from gi_core.constants import ALBEDO_MAX
from gi_core.errors import SourceError

SHARED_DATA = Path(__file__).parents[2].parent / "shared" / "data"
TRIANGLE = np.float32([[0, 0, 0], [2, 0, 0], [0, 0, -2]])


def gltf_tree(materials, *, nodes=None, uv=None, image=None, primitive=None):
    """A glTF with one triangle; buffers are inline."""
    chunks = [TRIANGLE.tobytes()]
    accessors = [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, -2], "max": [2, 0, 0]}]
    attributes = {"POSITION": 0}
    if uv is not None:
        attributes["TEXCOORD_0"] = 1
        accessors.append({"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"})
        chunks.append(np.float32(uv).tobytes())
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, **({"material": 0} if materials else {}), **(primitive or {})}]}],
        "accessors": accessors,
    }
    if materials:
        tree["materials"] = materials
    if image is not None:
        png = io.BytesIO()
        Image.fromarray(image).save(png, "PNG")
        tree["images"] = [{"mimeType": "image/png", "bufferView": len(chunks)}]
        tree["textures"] = [{"source": 0}]
        chunks.append(png.getvalue())
    data, views = b"", []
    for chunk in chunks:
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(chunk)})
        data += chunk + b"\0" * (-len(chunk) % 4)
    tree["bufferViews"] = views
    tree["buffers"] = [{"byteLength": len(data)}]
    return tree, data


def glb_bytes(tree, data):
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


def write_glb(path, tree, data):
    path.write_bytes(glb_bytes(tree, data))
    return path


def write_gltf(path, tree, data):
    tree["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    path.write_text(json.dumps(tree))
    return path


@pytest.mark.parametrize("write", [write_glb, write_gltf])
def test_base_colour_is_linear_and_not_rounded_to_bytes(tmp_path, write):
    factor = [0.123456, 0.5, 0.9876, 1.0]
    path = write(tmp_path / f"a.{write.__name__[6:]}", *gltf_tree([{"pbrMetallicRoughness": {"baseColorFactor": factor}}]))
    scene = load_scene(path)
    assert scene.albedo[0] == pytest.approx([0.123456, 0.5, ALBEDO_MAX], abs=1e-6)
    assert (scene.emission == 0).all()


def test_emission_is_factor_times_strength_in_candela(tmp_path):
    material = {"emissiveFactor": [1.0, 0.5, 0.25], "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4000.0}}}
    tree, data = gltf_tree([material])
    tree["extensionsUsed"] = ["KHR_materials_emissive_strength"]
    scene = load_scene(write_glb(tmp_path / "lamp.glb", tree, data))
    assert scene.emission[0] == pytest.approx([4000, 2000, 1000])


def test_materials_with_the_same_name_stay_apart(tmp_path):
    materials = [{"name": "m", "pbrMetallicRoughness": {"baseColorFactor": [value] * 3 + [1]}} for value in (0.1, 0.7)]
    tree, data = gltf_tree(materials)
    tree["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "material": 1})
    tree["meshes"].append({"primitives": [tree["meshes"][0]["primitives"].pop()]})
    tree["nodes"] = [{"mesh": 0}, {"mesh": 1, "translation": [0, 5, 0]}]
    tree["scenes"][0]["nodes"] = [0, 1]
    scene = load_scene(write_glb(tmp_path / "two.glb", tree, data))
    height = scene.vertices[scene.triangles[:, 0], 1]
    assert scene.albedo[height == 0][0] == pytest.approx([0.1] * 3)
    assert scene.albedo[height == 5][0] == pytest.approx([0.7] * 3)


def test_the_scene_graph_is_applied_and_mirrors_keep_the_outside_out(tmp_path):
    nodes = [
        {"children": [1], "translation": [10, 0, 0]},
        {"mesh": 0, "scale": [-1, 1, 1]},
    ]
    scene = load_scene(write_glb(tmp_path / "mirror.glb", *gltf_tree([], nodes=nodes)))
    assert scene.bounds.tolist() == [[8, 0, -2], [10, 0, 0]]
    a, b, c = scene.vertices[scene.triangles[0]]
    assert np.cross(b - a, c - a)[1] > 0, "the triangle faced up before it was mirrored along x"
    assert scene.albedo[0] == pytest.approx([DEFAULT_ALBEDO] * 3)


def test_a_texture_counts_with_its_mean_over_the_triangle_in_linear_light(tmp_path):
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, 32:] = 188  # right half: 0.503 linear
    material = {"pbrMetallicRoughness": {"baseColorFactor": [0.8, 0.4, 0.2, 1], "baseColorTexture": {"index": 0}}}
    half = float(linear_from_srgb(np.uint8([188]))[0])
    cases = {
        "left": ([[0, 0], [0.5, 0], [0, 1]], 0.0),
        "right": ([[0.5, 0], [1, 0], [1, 1]], half),
        "all, repeated twenty times": ([[0, 0], [20, 0], [0, 20]], half / 2),
    }
    for name, (uv, mean) in cases.items():
        scene = load_scene(write_glb(tmp_path / "t.glb", *gltf_tree([material], uv=uv, image=image)))
        # 64 samples; a triangle's edge along the texture's border may put single ones on the other side.
        assert scene.albedo[0] == pytest.approx(np.array([0.8, 0.4, 0.2]) * mean, abs=0.02), name


def test_the_texture_is_the_right_way_up(tmp_path):
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4] = (255, 0, 0)  # top half, which glTF addresses with v < 0.5
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    scene = load_scene(write_glb(tmp_path / "up.glb", *gltf_tree([material], uv=[[0.1, 0.05], [0.9, 0.05], [0.5, 0.4]], image=image)))
    assert scene.albedo[0] == pytest.approx([ALBEDO_MAX, 0, 0], abs=1e-6)
    moved = {"index": 0, "extensions": {"KHR_texture_transform": {"offset": [0, 0.5]}}}
    tree = gltf_tree([{"pbrMetallicRoughness": {"baseColorTexture": moved}}], uv=[[0.1, 0.05], [0.9, 0.05], [0.5, 0.4]], image=image)
    assert load_scene(write_glb(tmp_path / "moved.glb", *tree)).albedo[0] == pytest.approx([0, 0, 0], abs=1e-6)


def test_the_mean_agrees_with_a_dense_sum_on_noise():
    rng = np.random.default_rng(3)
    image = rng.integers(0, 256, (96, 57, 3), np.uint8)
    uv = rng.uniform(-1, 2, (30, 2))
    triangles = rng.permutation(30).reshape(10, 3)
    found = mean_over_triangles(image, uv, triangles)
    weights = rng.dirichlet((1, 1, 1), 40_000)
    at = np.einsum("sk,tkc->tsc", weights, uv[triangles]) % 1
    texel = image[(at[..., 1] * 96).astype(int), (at[..., 0] * 57).astype(int)]
    expected = linear_from_srgb(texel).mean(axis=1)
    # White noise is the worst texture there is: 64 samples of a deviation of 0.3 leave 0.04; mips do better, three sigma are allowed.
    assert np.abs(found - expected).max() < 0.12


def test_obj_and_ply_colours(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 0.7 0.2 0.1\nKe 5 6 7\n")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nusemtl red\nv 0 0 0\nv 1 0 0\nv 0 0 -1\nf 1 2 3\n")
    scene = load_scene(tmp_path / "a.obj")
    assert scene.albedo[0] == pytest.approx([0.7, 0.2, 0.1])
    assert scene.emission[0] == pytest.approx([5, 6, 7])
    mesh = trimesh.Trimesh(TRIANGLE, [[0, 1, 2]], vertex_colors=[[188, 0, 255, 255]] * 3, process=False)
    mesh.export(tmp_path / "a.ply")
    assert load_scene(tmp_path / "a.ply").albedo[0] == pytest.approx([0.5029, 0, ALBEDO_MAX], abs=1e-3)


def broken_files():
    """What is in the file, and what the error says."""

    def glb():
        return glb_bytes(*gltf_tree([{}]))

    def gltf(change):
        tree, data = gltf_tree([{}])
        tree["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
        change(tree)
        return json.dumps(tree).encode()

    def primitive(**changes):
        return gltf(lambda tree: tree["meshes"][0]["primitives"][0].update(changes))

    huge = b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n"
    return {
        "empty.glb": (b"", "no GLB version 2 header"),
        "half.glb": (glb()[: len(glb()) // 2], r"\d+ of \d+ bytes"),
        "cut.glb": (glb()[:-4], r"\d+ of \d+ bytes"),
        "noise.glb": (bytes(range(256)) * 4, "no GLB version 2 header"),
        "list.gltf": (b"[]", "expected a glTF 2.0 file"),
        "text.gltf": (b"not json", "expected a glTF 2.0 file"),
        "deep.gltf": (b"[" * 100_000, "expected a glTF 2.0 file"),
        "huge.gltf": (gltf(lambda tree: tree["accessors"][0].update(count=10**12)), "at most 50,000,000 triangles"),
        "outside.gltf": (primitive(attributes={"POSITION": 7}), "index out of range"),
        "no_material.gltf": (primitive(material=3), "index out of range"),
        "fan.gltf": (primitive(mode=6), "found a triangle fan"),
        "points.gltf": (primitive(mode=0), "expected triangles, found none"),
        "normalized.gltf": (gltf(lambda tree: tree["accessors"][0].update(normalized=True)), "POSITION as plain numbers"),
        "packed.gltf": (gltf(lambda tree: tree.update(extensionsRequired=["KHR_draco_mesh_compression"])), "the extension KHR_draco"),
        "lost_buffer.gltf": (gltf(lambda tree: tree["buffers"][0].update(uri="none.bin")), "broken"),
        "no_triangles.obj": (b"v 0 0 0\n", "expected triangles, found none"),
        "empty.obj": (b"", "expected triangles, found none"),
        "huge.ply": (huge, "broken"),
        "text.ply": (b"hello", "broken"),
    }


@pytest.mark.parametrize("name", broken_files())
def test_a_broken_file_is_one_clear_line(tmp_path, name):
    path = tmp_path / name
    content, said = broken_files()[name]
    path.write_bytes(content)
    with pytest.raises(SourceError, match=said) as error:
        load_scene(path)
    assert str(error.value).count(str(path)) == 1
    assert "expected" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_a_folder_and_an_unknown_kind_are_refused(tmp_path):
    with pytest.raises(SourceError, match="no such file"):
        load_scene(tmp_path / "none.glb")
    with pytest.raises(SourceError, match="folder"):
        load_scene(tmp_path)
    (tmp_path / "a.fbx").write_bytes(b"x")
    with pytest.raises(SourceError, match=r"found \.fbx"):
        load_scene(tmp_path / "a.fbx")


@pytest.mark.skipif(not SHARED_DATA.is_dir(), reason="the shared test cities are not beside this checkout")
@pytest.mark.parametrize(("name", "triangles"), [("munich.glb", 38_936), ("florence.glb", 35_373)])
def test_a_real_city_centre_loads_whole(name, triangles):
    scene = load_scene(SHARED_DATA / name)
    assert len(scene.triangles) == triangles
    assert scene.bounds[0, 1] == 0, "its ground lies at 0"
    assert len(np.unique(scene.albedo, axis=0)) >= 3
