"""Creates damaged files for fuzzing, by changes of the structure or the bytes of a valid file."""

from __future__ import annotations

import copy
import io
import json
import xml.etree.ElementTree as ElementTree

import yaml
from hypothesis import strategies as st

NUMBERS = (0, -1, 1e-320, -1e308, 1e308, float("nan"), float("inf"), -float("inf"), 10**30, 10**400, 2**63, 1e-9, 0.1)
TEXTS = (
    "",
    "nan",
    "1e999",
    "x",
    "\0",
    "../..",
    "/dev/zero",
    "/",
    "tr\u00fce",
    "a" * 300,
    "x" * 100_000,
    "[",
    "_",
    "-.inf",
)
#: Values that replace valid ones.
JUNK = st.one_of(
    st.sampled_from((*NUMBERS, *TEXTS, None, True, [], {}, [[]], {"a": 1}, [1, 2, 3], "[" * 3000)),
    st.integers(-100, 100),
    st.floats(width=32),
    st.text(max_size=8),
)
#: Texts that replace a cell of a CSV file or a text of an XML file.
WORDS = st.sampled_from(
    ("", " ", "nan", "-inf", "1e999", "1_0", "0x10", "abc", '"', "'", "#", ";", "1e308", "-1e308", "1e-320", "9" * 5000)
)


def slots(content: object) -> list[tuple[object, object]]:
    """Returns (container, key) of every value in nested lists and mappings."""
    found, waiting = [], [content]
    while waiting:
        container = waiting.pop()
        keys = container.keys() if isinstance(container, dict) else range(len(container))
        for key in keys:
            found.append((container, key))
            if isinstance(container[key], dict | list):
                waiting.append(container[key])
    return found


@st.composite
def changed_content(draw: st.DrawFn, content: object) -> object:
    """Returns the nested lists and mappings of a file with one to three changes."""
    content = copy.deepcopy(content)
    for _ in range(draw(st.integers(1, 3))):
        places = slots(content)
        if not places:
            return content
        container, key = draw(st.sampled_from(places))
        change = draw(st.sampled_from(("replace", "replace", "delete", "double", "swap", "scale", "rename")))
        value = container[key]
        if change == "delete":
            del container[key]
        elif change == "double" and isinstance(container, list):
            container.insert(key, copy.deepcopy(value))
        elif change == "swap":
            other, other_key = draw(st.sampled_from(places))
            container[key], other[other_key] = copy.deepcopy(other[other_key]), copy.deepcopy(value)
        elif change == "scale" and isinstance(value, int | float) and abs(value) < 1e300:
            container[key] = value * draw(st.sampled_from((-1, 0, 1e6, 1e-6, 1.01)))
        elif change == "rename" and isinstance(container, dict):
            container[f"{key}{draw(st.text(max_size=3))}"] = container.pop(key)
        else:
            container[key] = copy.deepcopy(draw(JUNK))  # a later change must not modify JUNK
    return content


@st.composite
def changed_bytes(draw: st.DrawFn, content: bytes) -> bytes:
    """Returns the bytes of a file, damaged in one place."""
    position = draw(st.integers(0, len(content)))
    length = draw(st.integers(1, 200))
    noise = draw(st.binary(min_size=1, max_size=8))
    lines = content.splitlines(keepends=True) or [b""]
    line = draw(st.integers(0, len(lines) - 1))
    damages = {
        "cut": lambda: content[:position],
        "hole": lambda: content[:position] + content[position + length :],
        "twice": lambda: content[: position + length] + content[position:],
        "noise": lambda: content[:position] + noise + content[position + len(noise) :],
        "inserted": lambda: content[:position] + noise + content[position:],
        "line lost": lambda: b"".join(lines[:line] + lines[line + 1 :]),
        "line twice": lambda: b"".join(lines[: line + 1] + lines[line:]),
        "random": lambda: noise * length,
    }
    return damages[draw(st.sampled_from(sorted(damages)))]()


def fixed_damages(content: bytes) -> dict[str, bytes]:
    """Returns a mapping from a name to a damaged file, as caused by editors, other systems or attackers."""
    middle = content.find(b"\n", len(content) // 2) + 1
    before, after = content[:middle], content[middle:]
    aliases = [b"a%d: &a%d [%s]\n" % (k, k, b", ".join([b"*a%d" % (k - 1)] * 9) if k else b"1") for k in range(12)]
    return {
        "empty": b"",
        "BOM": b"\xef\xbb\xbf" + content,
        "CRLF": content.replace(b"\n", b"\r\n"),
        "CR": content.replace(b"\n", b"\r"),
        "one line": content.replace(b"\n", b" "),
        "UTF-16": content.decode("latin-1").encode("utf-16"),
        "zeros": content + b"\0" * 1000,
        "doubled": content + content,
        "long line": before + b"7" * 3_000_000 + after,
        "nested lists": before + b"[" * 100_000,
        "nested mappings": b"{a: " * 100_000,
        "nested elements": before + b"<a>" * 100_000,
        "JSON lists": b'{"GC_controller": ' + b"[" * 100_000,
        "aliases": b"".join(aliases),
        "alias of itself": b"a: &a [*a]\n" + content,
        "entities": b'<!DOCTYPE x [<!ENTITY a "aaaa">' + b"".join(
            b'<!ENTITY a%d "%s">' % (k, (b"&a%d;" % (k - 1) if k else b"&a;") * 10) for k in range(10)
        ) + b"]><sdf><model>&a9;</model></sdf>",
    }  # fmt: skip


def _yaml(content: object) -> bytes:
    return yaml.dump(content, allow_unicode=True, default_flow_style=None).encode("utf-8", "surrogatepass")


def _json(content: object) -> bytes:
    return json.dumps(content).encode()


def _rows(content: list) -> bytes:
    rows = [row if isinstance(row, list) else [row] for row in content] if isinstance(content, list) else [[content]]
    return "\n".join(",".join(map(str, row)) for row in rows).encode("utf-8", "surrogatepass") + b"\n"


@st.composite
def changed_xml(draw: st.DrawFn, content: bytes) -> bytes:
    """Returns an XML file with one to three changes of its elements."""
    root = ElementTree.fromstring(content)
    for _ in range(draw(st.integers(1, 3))):
        parents = [element for element in root.iter() if len(element)]
        if not parents:
            break
        parent = draw(st.sampled_from(parents))
        child = draw(st.sampled_from(list(parent)))
        word = draw(WORDS)
        change = draw(st.sampled_from(("text", "text", "delete", "delete", "double", "attribute", "tag", "into")))
        if change == "text":
            child.text = word
        elif change == "delete":
            parent.remove(child)
        elif change == "double":
            parent.append(copy.deepcopy(child))
        elif change == "attribute":
            child.set(draw(st.sampled_from(("name", "type", "joint", "multiplier", "attached_to"))), word)
        elif change == "tag":
            child.tag = draw(st.sampled_from(("link", "joint", "mass", "effort", "inertial", "frame", "model", "axis")))
        else:
            draw(st.sampled_from(parents)).append(copy.deepcopy(child))
    stream = io.BytesIO()
    ElementTree.ElementTree(root).write(stream)
    return stream.getvalue()


def damaged(kind: str, content: bytes) -> st.SearchStrategy[bytes]:
    """Returns a strategy for damaged files of a kind: "yaml", "json", "csv", "xml", or "binary" (bytes only)."""
    by_bytes = changed_bytes(content)
    if kind == "yaml":
        by_content = changed_content(yaml.safe_load(content)).map(_yaml)
    elif kind == "json":
        by_content = changed_content(json.loads(content)).map(_json)
    elif kind == "csv":
        rows = [line.split(",") for line in content.decode().splitlines()]
        by_content = changed_content(rows).map(_rows)
    elif kind == "xml":
        by_content = changed_xml(content)
    else:
        return by_bytes
    return st.one_of(by_content, by_content, by_bytes)
