"""Our KTX 2.0 files as npm's ktx-parse reads them, the reader that web viewers and glTF tools use."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

READER = "ktx-parse@2.0.0"
INSTALL_S, READ_S = 120, 60
SCRIPT = """
import { read } from "ktx-parse";
import { readFileSync, writeFileSync } from "node:fs";
const file = read(new Uint8Array(readFileSync(process.argv[2])));
const [block] = file.dataFormatDescriptor;
writeFileSync(process.argv[3], file.levels[0].levelData);
console.log(JSON.stringify({
  vkFormat: file.vkFormat, size: [file.pixelDepth, file.pixelHeight, file.pixelWidth], levels: file.levels.length,
  typeSize: file.typeSize, layers: file.layerCount, faces: file.faceCount, supercompression: file.supercompressionScheme,
  texelBytes: block.bytesPlane[0],
  samples: block.samples.map((s) => [s.bitOffset, s.bitLength + 1, s.channelType]),
  orientation: file.keyValue["KTXorientation"], keys: Object.keys(file.keyValue),
}));
"""

pytestmark = [pytest.mark.slow, pytest.mark.skipif(shutil.which("npm") is None, reason="npm, which fetches the reader, is not here")]


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the script and what it imports."""
    folder = tmp_path_factory.mktemp("reader")
    (folder / "package.json").write_text('{"type": "module", "private": true}')
    (folder / "read.js").write_text(SCRIPT)
    command = ["npm", "install", "--no-audit", "--no-fund", "--ignore-scripts", READER]
    done = subprocess.run(command, cwd=folder, check=False, capture_output=True, text=True, timeout=INSTALL_S)
    if done.returncode:
        pytest.skip(f"npm could not fetch {READER}: {done.stderr.strip().splitlines()[:1]}")
    return folder


@pytest.mark.parametrize(
    ("query", "vulkan", "size", "texel_bytes", "raw"),
    [
        ({}, 97, [96, 32, 32], 8, {"format": "raw", "encoding": "f16"}),
        ({"encoding": "rgb9e5"}, 123, [96, 32, 32], 4, {"format": "raw", "encoding": "rgb9e5"}),
        ({"mask": 1}, 13, [32, 16, 32], 1, {"mask": 1, "format": "raw"}),
    ],
    ids=["f16", "rgb9e5", "mask"],
)
def test_it_finds_what_raw_has(
    http: httpx.Client,
    place: dict[str, Any],
    moment: dict[str, Any],
    reader: Path,
    tmp_path: Path,
    query: Any,
    vulkan: int,
    size: list[int],
    texel_bytes: int,
    raw: Any,
) -> None:
    texture, texels = tmp_path / "volume.ktx2", tmp_path / "texels"
    texture.write_bytes(http.get("/v1/volume", params=place | moment | query | {"format": "ktx2"}).content)
    command = ["node", "read.js", str(texture), str(texels)]
    done = subprocess.run(command, cwd=reader, check=True, capture_output=True, text=True, timeout=READ_S)
    found = json.loads(done.stdout)
    assert (found["vkFormat"], found["size"], found["texelBytes"]) == (vulkan, size, texel_bytes)
    assert (found["levels"], found["layers"], found["faces"], found["supercompression"]) == (1, 0, 1, 0)
    assert found["orientation"] == "ruo"
    data = texels.read_bytes()
    assert len(data) == np.prod(size) * texel_bytes
    same = http.get("/v1/volume", params=place | moment | raw).content
    assert sorted(np.frombuffer(data, f"V{texel_bytes}").tolist()) == sorted(np.frombuffer(same, f"V{texel_bytes}").tolist())
