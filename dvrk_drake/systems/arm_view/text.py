"""Text in a Meshcat scene. Meshcat has no text, so a text is drawn as a textured rectangle."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh

#: Height of a line of text, size of the font, and margin around the text [pixel].
LINE, FONT, MARGIN = 44, 32, 12
Color = tuple[int, int, int, int]
INK, PAPER = (20, 26, 33, 255), (255, 255, 255, 225)


@cache
def _font() -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(Path(mpl.get_data_path()) / "fonts/ttf/DejaVuSans.ttf", FONT)


def text_image(text: str, ink: Color = INK, paper: Color = PAPER) -> Image.Image:
    """Returns an image of a text of one or more lines on a rounded rectangle of the colour `paper`."""
    lines = text.split("\n")
    width = max(int(_font().getlength(line)) for line in lines) + 2 * MARGIN
    image = Image.new("RGBA", (width, LINE * len(lines) + MARGIN), (*paper[:3], 0))
    draw = ImageDraw.Draw(image)
    draw.rounded_rectangle((0, 0, image.width - 1, image.height - 1), 10, fill=paper)
    for i, line in enumerate(lines):
        draw.text((MARGIN, (i + 0.5) * LINE + MARGIN / 2), line, ink, _font(), "lm")
    return image


def color_scale_image(title: str, colors: Sequence[ArrayLike], labels: Sequence[str]) -> Image.Image:
    """Returns an image of a colour scale.

    Args:
        title: Text above the scale.
        colors: RGB colours of the scale, from left to right, each component in 0..1.
        labels: Texts below the scale, evenly distributed from its left to its right end.
    """
    text = text_image(title)
    width, inset = max(text.width, 520), 64
    image = Image.new("RGBA", (width, 3 * LINE), PAPER)
    image.paste(text.crop((4, 4, text.width - 4, text.height - 4)), ((width - text.width) // 2 + 4, 0))
    draw = ImageDraw.Draw(image)
    edges = np.linspace(inset, width - inset, len(colors) + 1)
    for left, right, color in zip(edges, edges[1:], colors, strict=False):
        draw.rectangle((left, LINE + 8, right, 2 * LINE - 6), fill=tuple((255 * np.asarray(color)).astype(int)))
    for x, label in zip(np.linspace(inset, width - inset, len(labels)), labels, strict=True):
        draw.text((x, 2.45 * LINE), label, INK, _font(), "mm")
    return image


def image_mesh(image: Image.Image, height: float) -> Mesh:
    """Returns a rectangle with an image, to be drawn with `Meshcat.SetObject`.

    The rectangle is in the x-z plane of its frame: x points to the right of the image, z points up, and the image
    faces -y. The origin is the centre of the image. Lights do not change its colours.

    Args:
        image: Image to show.
        height: Height of the rectangle [m].
    """
    half = 0.5 * height * np.array([image.width / image.height, 1.0])
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0.0]
    parts = (
        corners.astype("<f4").tobytes(),
        np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4").tobytes(),
        np.array([0, 1, 2, 0, 2, 3], "<u2").tobytes(),
    )
    png = io.BytesIO()
    image.save(png, "png")
    offsets = np.cumsum([0, *map(len, parts)])
    gltf = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [
            {
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
                "extensions": {"KHR_materials_unlit": {}},
                "alphaMode": "BLEND",
                "doubleSided": True,
            }
        ],
        "textures": [{"source": 0}],
        "images": [{"uri": _data_uri("image/png", png.getvalue())}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": 4,
                "type": "VEC3",
                "min": corners.min(axis=0).tolist(),
                "max": corners.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": int(start), "byteLength": len(part)}
            for start, part in zip(offsets, parts, strict=False)
        ],
        "buffers": [{"byteLength": int(offsets[-1]), "uri": _data_uri("application/octet-stream", b"".join(parts))}],
    }
    return Mesh(InMemoryMesh(mesh_file=MemoryFile(json.dumps(gltf), ".gltf", "text")))


def _data_uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"
