"""GLB, glTF, OBJ and PLY meshes through trimesh: positions in the world, albedo and emission per triangle.

glTF: albedo = baseColorFactor (linear) x the mean of baseColorTexture over the triangle; emission [cd m^-2] = emissiveFactor x
KHR_materials_emissive_strength x the mean of emissiveTexture. Factors are read from the file's JSON, since trimesh rounds them to
8 bits. Vertex colours count only where a primitive has no material. Alpha is ignored: every surface is opaque.
OBJ: Kd (linear) x the mean of map_Kd; Ke is emission. PLY: vertex or face colours, sRGB as scanners write them.
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from bake_jobs.clean import MAX_TRIANGLES
from bake_jobs.scene import Mesh, SourceContent, join_meshes
from bake_jobs.texture_mean import linear_from_srgb, mean_over_triangles
from gi_core.arrays import AnyArray, Float32, Int64
from gi_core.errors import SourceError

MESH_SUFFIXES = (".glb", ".gltf", ".obj", ".ply")
DEFAULT_ALBEDO = 0.5  # of a surface whose file says nothing about its colour
_GLB_MAGIC, _JSON_CHUNK = 0x46546C67, 0x4E4F534A
_TRIANGLE_FAN = 6
_MAX_VALUES = 6 * MAX_TRIANGLES  # indices, positions, normals and texture coordinates of the largest mesh
# Extensions that change where vertices are, and that trimesh does not read.
_UNREADABLE_EXTENSIONS = ("EXT_meshopt_compression", "KHR_draco_mesh_compression", "EXT_mesh_gpu_instancing")


def load_mesh(path: Path) -> SourceContent:
    """Read a mesh file with its scene graph applied. Raises SourceError, never an error of the reader's."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from error
    suffix = path.suffix.lower()
    materials: list[dict[str, Any]] = []
    if suffix in (".glb", ".gltf"):
        data, materials = _number_materials(data, suffix, path)
    try:
        resolver = trimesh.resolvers.FilePathResolver(str(path))
        loaded = trimesh.load_scene(io.BytesIO(data), file_type=suffix[1:], resolver=resolver, process=False)
        instances = [(loaded.geometry[loaded.graph[node][1]], loaded.graph[node][0]) for node in sorted(loaded.graph.nodes_geometry)]
        instances = [(mesh, to_world) for mesh, to_world in instances if isinstance(mesh, trimesh.Trimesh)]
        total = sum(len(mesh.faces) for mesh, _ in instances)
        if total > MAX_TRIANGLES:
            raise SourceError(f"{path}: expected at most {MAX_TRIANGLES:,} triangles, found {total:,}; split the city into several bakes")
        return SourceContent(join_meshes([_placed(mesh, np.asarray(to_world), suffix, materials) for mesh, to_world in instances]))
    except SourceError:
        raise
    except Exception as error:  # the reader raises whatever a malformed file leads it to
        detail = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"  # a KeyError's own text is a name and nothing else
        raise SourceError(
            f"{path}: expected a readable {suffix[1:].upper()} mesh, found a broken one ({detail}); export it again"
        ) from error


def _number_materials(data: bytes, suffix: str, path: Path) -> tuple[bytes, list[dict[str, Any]]]:
    """The file with its materials renamed to their index, so that trimesh's geometry leads back to them; and the materials."""
    try:
        text, rest = _glb_json(data) if suffix == ".glb" else (data, b"")
        tree = json.loads(text)
        _refuse_unreadable(tree, path)
        materials = list(tree.pop("materials", []))
        if materials:
            tree["materials"] = [{**material, "name": str(index)} for index, material in enumerate(materials)]
    except SourceError:
        raise
    except (ValueError, TypeError, AttributeError, LookupError, RecursionError) as error:
        raise SourceError(f"{path}: expected a glTF 2.0 file, found a broken one ({error}); export it again") from error
    text = json.dumps(tree).encode()
    if suffix == ".gltf":
        return text, materials
    text += b" " * (-len(text) % 4)
    head = np.array([_GLB_MAGIC, 2, 20 + len(text) + len(rest), len(text), _JSON_CHUNK], "<u4")
    return head.tobytes() + text + rest, materials


def _glb_json(data: bytes) -> tuple[bytes, bytes]:
    """The JSON chunk's text and the chunks after it. Raises ValueError."""
    head = [int(word) for word in np.frombuffer(data[: len(data[:20]) // 4 * 4], "<u4")]
    if len(head) < 5 or head[0] != _GLB_MAGIC or head[1] != 2 or head[4] != _JSON_CHUNK:
        raise ValueError("no GLB version 2 header")
    end = 20 + head[3]
    if len(data) < max(head[2], end):
        raise ValueError(f"{len(data)} of {max(head[2], end)} bytes")
    return data[20:end], data[end:]


def _refuse_unreadable(tree: dict[str, Any], path: Path) -> None:
    """Refuse what trimesh would read wrongly in silence, and counts that it would allocate before it looks at the data."""

    def refuse(expected: str, found: str) -> None:
        raise SourceError(f"{path}: expected {expected}, found {found}; export it again without compression")

    for extension in tree.get("extensionsRequired", []):
        if extension in _UNREADABLE_EXTENSIONS:
            refuse("plain glTF", f"the extension {extension}")
    accessors = tree.get("accessors", [])
    values = sum(int(accessor["count"]) for accessor in accessors)
    if values > _MAX_VALUES or any(int(accessor["count"]) < 0 for accessor in accessors):
        refuse(f"at most {MAX_TRIANGLES:,} triangles", f"accessors of {values:,} values")
    for mesh in tree.get("meshes", []):
        for primitive in mesh["primitives"]:
            if primitive.get("mode", 4) == _TRIANGLE_FAN:
                refuse("triangles or triangle strips", "a triangle fan")
            for name in ("POSITION", "TEXCOORD_0"):
                index = primitive["attributes"].get(name)
                if index is not None and (accessors[index].get("normalized") or "sparse" in accessors[index]):
                    refuse(f"{name} as plain numbers", "normalized integers or a sparse accessor")


def _placed(mesh: Any, to_world: AnyArray, suffix: str, materials: list[dict[str, Any]]) -> Mesh:
    """One instance of a trimesh geometry, in the world."""
    vertices = np.asarray(mesh.vertices, np.float64) @ to_world[:3, :3].T + to_world[:3, 3]
    triangles = np.asarray(mesh.faces, np.int64).reshape(-1, 3)
    if np.linalg.det(to_world[:3, :3]) < 0:
        triangles = triangles[:, ::-1]  # a mirror turns surfaces inside out
    albedo, emission = _look(mesh, triangles, suffix, materials)
    return Mesh(vertices, triangles, albedo, emission)


def _look(mesh: Any, triangles: Int64, suffix: str, materials: list[dict[str, Any]]) -> tuple[Float32, Float32]:
    """Albedo (m, 3), linear sRGB, and emission (m, 3) [cd m^-2]."""
    visual = mesh.visual
    albedo: Float32 = np.full((len(triangles), 3), DEFAULT_ALBEDO, np.float32)
    emission: Float32 = np.zeros((len(triangles), 3), np.float32)
    if visual.kind == "texture":
        if suffix in (".glb", ".gltf"):
            return _gltf_look(visual, materials[int(visual.material.name)], triangles)
        material = visual.material
        said = getattr(material, "kwargs", {})
        image = getattr(material, "image", None)
        if "kd" in said:
            albedo[:] = np.asarray(said["kd"], np.float32)
        elif image is not None:
            albedo[:] = 1
        if "ke" in said:
            emission[:] = np.array([float(value) for value in said["ke"]], np.float32)
        albedo *= _texture_mean(image, visual.uv, triangles)
    elif visual.kind in ("vertex", "face"):
        per_vertex = visual.kind == "vertex"
        colour = np.asarray(visual.vertex_colors if per_vertex else visual.face_colors)[:, :3].astype(np.uint8)
        # glTF's vertex colours are linear; those in PLY and OBJ files come from cameras and painters, so sRGB.
        linear = colour.astype(np.float32) / 255 if suffix in (".glb", ".gltf") else linear_from_srgb(colour)
        albedo = np.asarray(linear[triangles].mean(axis=1) if per_vertex else linear, np.float32)
    return albedo, emission


def _gltf_look(visual: Any, material: dict[str, Any], triangles: Int64) -> tuple[Float32, Float32]:
    metallic = material.get("pbrMetallicRoughness", {})
    extensions = material.get("extensions", {})
    strength = float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
    albedo = np.asarray(metallic.get("baseColorFactor", (1, 1, 1, 1)), np.float32)[:3] * np.ones((len(triangles), 1), np.float32)
    emission = np.float32(strength) * np.asarray(material.get("emissiveFactor", (0, 0, 0)), np.float32)
    emission = emission * np.ones((len(triangles), 1), np.float32)
    for said, key, values in ((metallic, "baseColorTexture", albedo), (material, "emissiveTexture", emission)):
        if key in said and values.any():
            image = getattr(visual.material, key)
            if image is None:
                raise ValueError(f"{key} of material {material.get('name', '?')!r} cannot be read")
            values *= _texture_mean(image, _transformed_uv(visual.uv, said[key], material), triangles)
    return albedo, emission


def _transformed_uv(uv: AnyArray | None, texture: dict[str, Any], material: dict[str, Any]) -> AnyArray | None:
    """uv after KHR_texture_transform, in trimesh's sense (v up)."""
    transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
    if transform.get("texCoord", texture.get("texCoord", 0)) != 0:
        raise ValueError(f"material {material.get('name', '?')!r} uses a second set of texture coordinates, only TEXCOORD_0 is read")
    if uv is None or not transform:
        return uv
    scale = np.asarray(transform.get("scale", (1, 1)), np.float64)
    turn = float(transform.get("rotation", 0.0))
    u, v = uv[:, 0] * scale[0], (1 - uv[:, 1]) * scale[1]
    offset = transform.get("offset", (0, 0))
    u, v = u * np.cos(turn) + v * np.sin(turn) + offset[0], v * np.cos(turn) - u * np.sin(turn) + offset[1]
    return np.stack([u, 1 - v], axis=1)


def _texture_mean(image: Any, uv: AnyArray | None, triangles: Int64) -> Float32:
    """(m, 3) linear factors; 1 where there is no texture or no coordinates to look it up with."""
    if image is None or uv is None:
        return np.ones((len(triangles), 3), np.float32)
    downward = np.stack([np.asarray(uv)[:, 0], 1 - np.asarray(uv)[:, 1]], axis=1)  # trimesh's v is 0 at the bottom row
    return mean_over_triangles(np.asarray(image.convert("RGB")), downward, triangles)
