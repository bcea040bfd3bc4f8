"""Files against structures: each kind of mistake is one sentence with place, what was found and what is allowed."""

import json
from typing import Annotated, Literal

import pytest
from msgspec import Meta

from rrr_oc.errors import UserError
from rrr_oc.schema import Interval, NonNegative, Schema, Text, Vector, check_interval, parsed, read_json, read_preset, validated


class Inner(Schema, frozen=True):
    name: Text
    kind: Literal["a", "b"] = "a"
    size: NonNegative = 0.0
    point: Vector = (0.0, 0.0, 0.0)
    bounds: Interval | None = None

    def __post_init__(self) -> None:
        check_interval("bounds", self.bounds)


class Outer(Schema, frozen=True):
    one: Inner
    named: dict[str, Inner] | None = None
    many: Annotated[list[Inner], Meta(min_length=1)] | None = None
    some: Inner | list[Inner] | None = None
    sure: bool = True
    files: Literal["all"] | tuple[str, ...] = "all"


GOOD = {"name": "x"}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "f: found []; an object with one, named, many, some, sure, files is required"),
        ({}, "f: key 'one' is missing; required are one"),
        ({"one": GOOD, "two": 2}, "f: unknown key 'two'; allowed are one, named, many, some, sure, files"),
        ({"one": {}}, "f: one: key 'name' is missing; required are name"),
        ({"one": {"name": " "}}, "f: one.name: found ' '; a text is required"),
        ({"one": {"name": "a\n"}}, "f: one.name: found 'a\\n'; a text is required"),
        ({"one": {**GOOD, "kind": True}}, "f: one.kind: found true; allowed are 'a', 'b'"),
        ({"one": {**GOOD, "size": -1}}, "f: one.size: found -1; a finite number of 0 or more is required"),
        ({"one": {**GOOD, "size": None}}, "f: one.size: found null; a finite number of 0 or more is required"),
        (
            {"one": {**GOOD, "size": [None, {}, False]}},
            "f: one.size: found [null, {}, false]; a finite number of 0 or more is required",
        ),
        ({"one": {**GOOD, "size": True}}, "f: one.size: found true; a finite number of 0 or more is required"),
        ({"one": {**GOOD, "point": [1, 2]}}, "f: one.point: found [1, 2]; a list of 3 numbers is required"),
        (
            {"one": {**GOOD, "point": [1, 2, "z"]}},
            "f: one.point[2]: found 'z'; a finite number from -10000 to 10000 is required",
        ),
        (
            {"one": {**GOOD, "bounds": [2, 1]}},
            "f: one.bounds: bounds are crossed: 2 … 1; the lower must not be above the upper",
        ),
        ({"one": GOOD, "named": {"j1": {"name": 3}}}, "f: named.j1.name: found 3; a text is required"),
        ({"one": GOOD, "many": []}, "f: many: found []; a list with at least one entry is required"),
        ({"one": GOOD, "many": [GOOD, 3]}, "f: many[1]: found 3; an object with name, kind, size, point, bounds is required"),
        ({"one": GOOD, "some": [GOOD, {"name": 3}]}, "f: some[1].name: found 3; a text is required"),
        ({"one": GOOD, "some": {"name": 3}}, "f: some.name: found 3; a text is required"),
        ({"one": GOOD, "sure": "yes"}, "f: sure: found 'yes'; true or false is required"),
        ({"one": GOOD, "files": ["x", 3]}, "f: files[1]: found 3; a text is required"),
        ({"one": GOOD, "files": "none"}, "f: files: found 'none'; allowed is 'all'"),
    ],
)
def test_what_is_wrong_is_one_sentence(data, message):
    with pytest.raises(UserError) as caught:
        validated("f", data, Outer)
    assert str(caught.value) == message


def test_numbers_may_be_written_as_integers():
    found = validated("f", {"one": {**GOOD, "size": 2, "point": [1, 2.5, 3]}, "some": [GOOD], "files": ["a"]}, Outer)
    assert (found.one.size, found.one.point, found.files) == (2.0, (1.0, 2.5, 3.0), ("a",))
    assert isinstance(found.one.size, float)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "f, line 1, column 2: not valid JSON"),
        ("", "f, line 1, column 1: not valid JSON"),
        ('{"a": {"b": 1, "b": 2}}', "f: key 'b' stands twice in one object"),
        ('{"a": [1, {"b": NaN}]}', r"f: a\[1\].b: found nan; a finite number is required"),
        ('{"a": 1e999}', "f: a: found inf; a finite number is required"),
        ('{"a": 1' + 400 * "0" + "}", r"f: a: found 10+\.\.\.0+; a finite number is required"),
        ("9" * 5000, "f: not usable JSON"),
        ("[" * 100_000, "f: not usable JSON"),
        ("[" * 300 + "]" * 300, "f: not usable JSON: brackets stand within each other more than 100 deep"),
    ],
)
def test_broken_json_is_one_sentence(text, message):
    with pytest.raises(UserError, match=message):
        parsed("f", text)


def test_files_and_presets(tmp_path):
    path = tmp_path / "a.json"
    path.write_text(json.dumps({"one": GOOD}))
    assert read_json(path, Outer) == Outer(Inner("x"))
    assert read_preset("thing", path, {}, Outer) == (str(path), Outer(Inner("x")))
    with pytest.raises(UserError, match=r"nowhere\.json: cannot be read"):
        read_json(tmp_path / "nowhere.json", Outer)
    with pytest.raises(
        UserError, match="no thing at 'nowhere'; give the path of a JSON file or the name of a bundled one: one, two"
    ):
        read_preset("thing", "nowhere", {"one": "1.json", "two": "2.json"}, Outer)
    path.write_bytes(b'{"one": "\xff"}')
    with pytest.raises(UserError, match="byte 0xff; text in UTF-8"):
        read_json(path, Outer)


def test_a_word_without_end_is_told_without_its_middle():
    """A sentence stays one that people read, whatever a damaged file holds; paths, which may be long, are told in full."""
    said = str(UserError(f"found {'ä' * 5000}; a number is required"))
    assert len(said) < 250
    assert said.startswith("found ää")
    assert said.endswith("ä; a number is required")
    path = "/".join(["folder"] * 100)
    assert str(UserError(f"{path}: cannot be read")) == f"{path}: cannot be read"
