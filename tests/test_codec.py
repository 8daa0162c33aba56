"""One contract for all records that become JSON or TOML and come back: the same value, or one clause with the place.

`tests/records/version_1.json` holds an example of each as files and messages of version 1 have it.
"""

from __future__ import annotations

import copy
import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import pytest
import tomli_w
from hypothesis import given, settings
from hypothesis import strategies as st

from dappled import codec
from dappled.codec import CodecError
from dappled.daemon.pipeline.picture_facts import PictureFacts
from dappled.daemon.pipeline.recipes import Names
from dappled.decode import DecodeError
from dappled.decode.calibration import LatticeFit
from dappled.decode.calibration.calibration import SweptDistance
from dappled.decode.depth.ranging import Ranging
from dappled.decode.geometry import Pose
from dappled.decode.joint.mask_place import MaskPlace
from dappled.decode.optics import LAWS, Mask, Sensor
from dappled.drivers.gphoto2.messages import Carryover
from dappled.drivers.gphoto2.settings import GPhoto2Settings
from dappled.drivers.raw.recipe import LawDecision, Recipe
from dappled.findings import Code, Finding, Subject, finding
from dappled.flight import Cause, Frame, Result, Shot, Stray, Tag
from dappled.flight.pruning import Removed
from dappled.flight.records import Judgement
from dappled.flight.seals import Seal
from dappled.products.batch.batch import Done
from dappled.products.handover.view_cameras import FrameCameras, ViewCamera

_ALL = (
    Carryover, Cause, Done, Finding, Frame, FrameCameras, GPhoto2Settings, Judgement, LatticeFit, LawDecision, Mask,
    MaskPlace, Names, PictureFacts, Pose, Ranging,
    Recipe, Removed, Result, Seal, Sensor, Shot, Stray, SweptDistance, Tag,
)  # fmt: skip
RECORDS: Mapping[str, type] = {one.__name__: one for one in _ALL}
_TURN, _BENT = (0.5,) * 9, (0.5,) * 5
OWN: Mapping[tuple[Any, str], Sequence[Any]] = {  # fields that take less than their type says
    (FrameCameras, "camera_to_ned"): (_TURN,),
    (FrameCameras, "distortion"): (_BENT,),
    (FrameCameras, "views"): ((ViewCamera("a", (1.0, 2.0), (0.5, 0.5), (0.0, 0.1, 0.2)),),),
    (LawDecision, "law"): tuple(LAWS),
    (Ranging, "gain_px_m"): (0.25, 80.0),
}
KEPT = Path(__file__).parent / "records" / "version_1.json"
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
WORDS = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
WHOLE = st.integers(-(2**63), 2**63 - 1)
LEAVES: Mapping[Any, st.SearchStrategy[Any]] = {
    str: WORDS,
    int: WHOLE,
    float: NUMBERS,
    bool: st.booleans(),
    type(None): st.none(),
    Any: st.none() | WORDS | WHOLE,
}
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | WORDS,
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(WORDS, inner, max_size=2),
    max_leaves=4,
)


def made(hint: Any, depth: int = 2) -> st.SearchStrategy[Any]:  # noqa: PLR0911  one line a kind
    """Values of a field's type; a record in its own kind ends at a depth."""
    origin, inner = get_origin(hint), get_args(hint)
    if hint in LEAVES:
        return LEAVES[hint]
    if origin in (Union, UnionType):
        return st.one_of(*(made(one, depth - 1) for one in inner if depth > 0 or one is type(None) or one in LEAVES))
    if origin is Literal:
        return st.sampled_from(inner)
    if origin is tuple and inner[-1] is not Ellipsis:
        return st.tuples(*(made(one, depth) for one in inner))
    if origin in (tuple, list, Sequence):
        many = st.lists(made(inner[0], depth), max_size=2)
        return many if origin is list else many.map(tuple)
    if is_dataclass(hint):
        record: Any = hint
        return st.builds(record, **{one.name: field(hint, one.name, depth) for one in fields(hint)})
    if issubclass(origin or hint, Mapping):
        return st.dictionaries(WORDS, made(inner[1], depth), max_size=2)
    assert issubclass(hint, Enum)
    return st.sampled_from(hint)


def field(record: Any, name: str, depth: int) -> st.SearchStrategy[Any]:
    """Values of a field."""
    own = OWN.get((record, name))
    return made(get_type_hints(record)[name], depth) if own is None else st.sampled_from(own)


def example(hint: Any, depth: int = 1) -> Any:
    """One value of a field's type, always the same, with everything filled in."""
    origin, inner = get_origin(hint), get_args(hint)
    simple = {str: "text", int: 7, float: 0.25, bool: True, type(None): None, Any: {"a": [1, None]}}
    if hint in simple:
        return simple[hint]
    if origin in (Union, UnionType):
        return example(inner[0], depth - 1) if depth > 0 or not is_dataclass(inner[0]) else None
    if origin is Literal:
        return inner[0]
    if origin in (tuple, list, Sequence):
        return (tuple if origin is tuple else list)(example(one, depth) for one in inner if one is not Ellipsis)
    if is_dataclass(hint):
        hints = get_type_hints(hint)
        record: Any = hint
        return record(
            **{one.name: OWN.get((hint, one.name), [example(hints[one.name], depth)])[0] for one in fields(hint)}
        )
    return {"key": example(inner[1], depth)} if issubclass(origin or hint, Mapping) else next(iter(hint))


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The path of each value in a tree, the tree itself first."""
    yield at
    if isinstance(value, dict | list):
        for key, one in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(one, (*at, key))


def put(tree: Any, at: tuple[Any, ...], value: Any) -> Any:
    """A copy of a tree with another value at a path."""
    if not at:
        return value
    changed = holder = copy.deepcopy(tree)
    for key in at[:-1]:
        holder = holder[key]
    holder[at[-1]] = value
    return changed


def refusal(kind: Any, value: Any) -> str:
    """Why it is no such record; "" where it is one."""
    try:
        codec.read(kind, value)
    except (CodecError, DecodeError) as error:
        return str(error)
    return ""


@pytest.mark.parametrize("kind", RECORDS.values(), ids=RECORDS)
@given(data=st.data())
@settings(max_examples=10)
def test_a_record_comes_back_as_it_was(kind: Any, data: st.DataObject) -> None:
    record = data.draw(made(kind))
    text = codec.canonical(record)
    back = codec.read_json(kind, text)
    assert back == record
    assert codec.canonical(back) == text


@pytest.mark.parametrize("kind", RECORDS.values(), ids=RECORDS)
@given(data=st.data())
@settings(max_examples=20)
def test_damage_is_read_as_another_record_or_refused_in_one_clause(kind: Any, data: st.DataObject) -> None:
    whole = codec.plain(example(kind))
    at = data.draw(st.sampled_from(sorted(places(whole), key=repr)))
    damaged = put(whole, at, data.draw(JSON))
    said = refusal(kind, damaged)
    assert len(said.splitlines()) <= 1
    assert len(said) < 600
    if not said:
        codec.canonical(codec.read(kind, damaged))  # nothing was let in that can't be written


@pytest.mark.parametrize("kind", RECORDS.values(), ids=RECORDS)
def test_each_key_is_needed_or_has_a_default_and_no_other_is_known(kind: Any) -> None:
    whole = codec.plain(example(kind))
    with pytest.raises(CodecError, match=r"^frob is not a known key; "):
        codec.read(kind, {**whole, "frob": 1})
    for name in whole:
        less = {key: value for key, value in whole.items() if key != name}
        assert refusal(kind, less) in ("", f"{name} is missing")


FILED = {name: kind for name, kind in RECORDS.items() if kind not in (Carryover, GPhoto2Settings, PictureFacts)}
"""Those that stand in files or on the wire; the others pass between processes of one version."""


@pytest.mark.parametrize("kind", FILED.values(), ids=FILED)
def test_version_1_is_written_and_read_as_ever(kind: Any) -> None:
    kept = json.loads(KEPT.read_text("utf-8"))[kind.__name__]
    assert codec.plain(example(kind)) == kept
    assert codec.read(kind, kept) == example(kind)


@pytest.mark.parametrize("text", ["{", "", "[1", '"\\ud8"', "[" * 100_000, "\xff", '{"a": 1}}'])
def test_what_is_no_json_is_refused(text: str) -> None:
    with pytest.raises(CodecError, match=r"^it is not JSON: "):
        codec.read_json(Shot, text)


@dataclass(frozen=True)
class Inner:
    share: float
    turned: tuple[int, int] | None = None


@dataclass(frozen=True)
class Outer:
    name: str
    side: Literal["left", "right"]
    parts: tuple[Inner, ...]
    by_name: Mapping[str, Inner]
    above: Outer | None = None


OUTER = codec.plain(Outer("a", "left", (Inner(1.0), Inner(2.0, (3, 4))), {"x": Inner(0.5)}))


@pytest.mark.parametrize(
    ("at", "value", "said"),
    [
        (("name",), 5, "name must be text, not 5"),
        (("side",), "up", "side must be one of left, right, not 'up'"),
        (("parts",), "no", "parts must be a list, not 'no'"),
        (("parts", 1), None, "parts[1] must be a table, not None"),
        (("parts", 1, "share"), True, "parts[1].share must be a number, not True"),
        (("parts", 1, "share"), float("nan"), "parts[1].share must be a finite number, not nan"),
        (("parts", 1, "share"), 10**400, "parts[1].share must be a finite number, not a very large number"),
        (("parts", 1, "turned"), [1], "parts[1].turned must be a list of 2 values, not [1]"),
        (("parts", 1, "turned", 0), 1.0, "parts[1].turned[0] must be a whole number, not 1.0"),
        (("by_name", "x", "share"), "1", "by_name.x.share must be a number, not '1'"),
        (("by_name", "x", "shar"), 1, "by_name.x.shar is not a known key; did you mean 'share'?"),
        (("by_name", "a\nb"), 1, r"by_name.'a\nb' must be a table, not 1"),
        (("above",), {}, "above.by_name is missing"),
        ((), [], "must be a table, not []"),
    ],
)
def test_what_is_wrong_is_told_with_its_place(at: tuple[Any, ...], value: Any, said: str) -> None:
    with pytest.raises(CodecError) as caught:
        codec.read(Outer, put(OUTER, at, value))
    assert str(caught.value) == said


def test_toml_leaves_out_what_is_unknown() -> None:
    record = Outer("a", "right", (Inner(1.0),), {}, Outer("b", "left", (), {}))
    assert codec.read(Outer, tomllib.loads(tomli_w.dumps(codec.table(record)))) == record


def test_an_unknown_number_is_never_written_as_one() -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        codec.canonical(Finding(Code.FRAME_CLIPPED, Subject("frame", 1), {"share": float("nan")}))


def test_a_number_stays_of_its_kind() -> None:
    assert type(codec.read(Inner, {"share": 1}).share) is float
    assert codec.read(Finding, codec.plain(finding(Code.FRAME_CLIPPED, Subject("frame", 7)))).subject.which == 7
