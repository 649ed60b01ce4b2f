"""Test vectors: what is in them, and that the C core passes them."""

import hashlib
import json
import re
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from random_dbc import SCENE_SEED, random_dbc
from scene_layouts import layout_of
from support import c_core

from maplines_can import Status
from maplines_can.generation.vector_files import cases_of, vectors_from
from maplines_can.generation.vectors import SCHEMA, Vectors
from maplines_can.wire import E2EState, ProfileStatus, Reason
from maplines_can.wire.layout.message_layout import Layout

pytest.importorskip("cryptography")

ROOT = Path(__file__).parents[2]
FOLDER = c_core.C / "tests" / "vectors"
SHIPPED = ("maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc", "maplines-scene.dbc")


@cache
def vectors(dbc: str) -> Vectors:
    return vectors_from(layout_of(dbc))


@cache
def content(dbc: str) -> Any:
    return json.loads(vectors(dbc).json)


def steps(dbc: str) -> list[Any]:
    return [step for case in content(dbc)["cases"] for step in case["steps"]]


def conforms(value: Any, schema: Any, root: Any) -> bool:
    """Whether a JSON value conforms to a schema, as far as ours uses JSON Schema."""
    if "$ref" in schema:
        name = schema["$ref"].removeprefix("#/$defs/")
        return conforms(value, root["$defs"][name], root)
    kinds: dict[str, Any] = {
        "object": dict, "array": list, "string": str, "boolean": bool, "integer": int,
        "number": (int, float), "null": type(None),
    }  # fmt: skip
    types = schema.get("type", [])
    types = [types] if isinstance(types, str) else types
    is_number = not isinstance(value, bool) or "boolean" in types
    if types and not (any(isinstance(value, kinds[kind]) for kind in types) and is_number):
        return False
    options = schema.get("oneOf") or schema.get("anyOf")
    matching = sum(conforms(value, option, root) for option in options or ())
    if options and (matching != 1 if "oneOf" in schema else not matching):
        return False
    if isinstance(value, str) and not re.search(schema.get("pattern", ""), value):
        return False
    if value not in schema.get("enum", [value]) or value != schema.get("const", value):
        return False
    if isinstance(value, int) and not (
        schema.get("minimum", value) <= value <= schema.get("maximum", value)
    ):
        return False
    if isinstance(value, list):
        return all(conforms(item, schema.get("items", {}), root) for item in value)
    if not isinstance(value, dict):
        return True
    known, others = schema.get("properties", {}), schema.get("additionalProperties", {})
    if others is False and not value.keys() <= known.keys():
        return False
    return (
        set(schema.get("required", ())) <= value.keys()
        and all(conforms(name, schema.get("propertyNames", {}), root) for name in value)
        and all(conforms(item, known.get(name, others or {}), root) for name, item in value.items())
    )


# ---- what is in them --------------------------------------------------------------------------


@pytest.mark.parametrize("dbc", SHIPPED)
def test_the_json_conforms_to_its_schema(dbc: str) -> None:
    schema = json.loads((FOLDER / SCHEMA).read_text())
    assert conforms(content(dbc), schema, schema)
    changes: list[dict[str, Any]]
    changes = [{"sha256": "0"}, {"cases": [{}]}, {"more": 1}, {"places": ["a"]}]
    for change in changes:
        assert not conforms(content(dbc) | change, schema, schema)


def test_every_reason_status_and_state_occurs() -> None:
    """Of the DBCs together; those that one of them can have, in it."""
    seen = {dbc: Counter[str]() for dbc in SHIPPED}
    for dbc in SHIPPED:
        for step in steps(dbc):
            seen[dbc].update([step["reason"]] if "reason" in step else [])
            seen[dbc].update(step.get("counts", {}).keys())
            seen[dbc].update(f"{name} {step[name]}" for name in ("state", "status") if name in step)
            seen[dbc].update(f"line {line['status']}" for line in step.get("lines", ()))
    everywhere = {f"state {state.name}" for state in E2EState}
    everywhere |= {f"status {status.name}" for status in ProfileStatus} | {"status NONE"}
    secoc = {"UNAUTHENTICATED", "KEY", "MAC", "REPLAY", "AGE"}
    # SPACING is off in the default settings, which the receivers of vectors have.
    common = {reason.name for reason in Reason} - secoc - {"POSE", "SPACING"}
    of_pages = {"PAGE", "REPLACED", "INCOMPLETE", "TIMEOUT", "MIXED"}
    for dbc in SHIPPED:
        none = of_pages if layout_of(dbc).scene else set()
        assert seen[dbc].keys() >= everywhere | common - none
    assert seen["maplines-secoc.dbc"].keys() >= secoc
    assert "POSE" in seen["maplines-pose.dbc"]
    assert seen["maplines.dbc"].keys() >= {f"line {status.name}" for status in Status}


@pytest.mark.parametrize("dbc", SHIPPED)
def test_there_are_usable_lines_and_scenes(dbc: str) -> None:
    for kind in ("view", "scene"):
        usable = Counter(step["is_usable"] for step in steps(dbc) if step["step"] == kind)
        assert usable[True] >= 3
        assert usable[False] >= 3
    assert any(step.get("two_senders") for step in steps(dbc))
    assert {len(step["slots"]) for step in steps(dbc) if step["step"] == "scene"} >= {0, 1, 2, 3}


@pytest.mark.parametrize("dbc", SHIPPED)
def test_the_hashes_are_those_of_the_dbc_and_of_the_cases(dbc: str) -> None:
    text = vectors(dbc).text
    body = text.split("\n", 4)[4]
    assert content(dbc)["sha256"] == hashlib.sha256(body.encode()).hexdigest()
    file = (ROOT / "dbc" / dbc).read_bytes()
    assert content(dbc)["dbc"] == {"name": dbc, "sha256": hashlib.sha256(file).hexdigest()}
    assert [line.split()[-1] for line in text.splitlines()[2:4]] == [
        content(dbc)["dbc"]["sha256"], content(dbc)["sha256"],
    ]  # fmt: skip


@pytest.mark.parametrize("seed", [*range(6), SCENE_SEED, SCENE_SEED + 1])
def test_any_dbc_has_vectors(tmp_path: Path, seed: int) -> None:
    """Also those without classic messages, or with other widths and places of all signals."""
    path = tmp_path / "random.dbc"
    path.write_text(random_dbc(seed))
    cases = cases_of(Layout.from_dbc(path))
    assert len(cases) > 80
    assert sum(len(step.get("complete", ())) for case in cases for step in case.steps) > 80
