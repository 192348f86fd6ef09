"""Configuration files: accepted values, and the exact sentence for each error; key files: how
they are made, which are refused, and that no message shows the key."""

from __future__ import annotations

import hashlib
import os
from enum import Enum
from pathlib import Path
from typing import Annotated, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st
from processes import full_disk
from pydantic import Field, model_validator

from offboard.documents.errors import UserError
from offboard.documents.parameters import Parameters
from offboard.documents.reading import (
    DocumentError,
    override,
    parse,
    read,
    validate,
)
from offboard.documents.shipped import SIZE_MOST
from offboard.documents.signing_key import create_key, read_key


class Colour(Enum):
    RED = "red"
    BLUE = "blue"


class Circle(Parameters):
    kind: Literal["circle"]
    radius_m: float = Field(gt=0, le=100)


class Line(Parameters):
    kind: Literal["line"]
    points: int = Field(ge=2, le=9)


class Drawing(Parameters):
    title: str = Field(min_length=1, max_length=5)
    scale: float = Field(default=1.0, gt=0, lt=10)
    tilt_rad: float = 0.0
    visible: bool = True
    colour: Colour = Colour.RED
    corner: tuple[float, float] = (0.0, 0.0)
    corners: Annotated[tuple[tuple[float, float], ...], Field(min_length=2)] = ((0, 0), (1, 1))
    shape: Annotated[Circle | Line, Field(discriminator="kind")] | None = None
    circles: list[Circle] = Field(default=[])
    named: dict[str, Circle] = Field(default={})

    @model_validator(mode="after")
    def _blue_is_flat(self) -> Drawing:
        if self.colour is Colour.BLUE and self.tilt_rad != 0.0:
            raise ValueError("a blue drawing is not tilted")
        return self


def problems(text: str) -> tuple[str, ...]:
    with pytest.raises(DocumentError) as caught:
        parse(text, Drawing, "d.yaml")
    assert str(caught.value) == "\n".join(caught.value.problems)
    return caught.value.problems


def test_scalars_follow_yaml_1_2() -> None:
    numbers = {"1e-3": 1e-3, "1E3": 1e3, "-2.5e+1": -25.0, ".5": 0.5, "3.": 3.0, "010": 10.0,
               "0x10": 16.0}  # fmt: skip
    for text, number in numbers.items():
        assert parse(f"title: a\ntilt_rad: {text}", Drawing, "d.yaml").tilt_rad == number
    for text in ("no", "12:30", "off", "'1'", '"true"', "a:b"):
        assert parse(f"title: {text}", Drawing, "d.yaml").title == text.strip("'\"")
    assert not parse("title: x\nvisible: false", Drawing, "d.yaml").visible


KEYS = "circles, colour, corner, corners, named, scale, shape, tilt_rad, title, visible"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        # values, with line and column of their keys
        ("scale: 2", "d.yaml: title is missing"),
        ("title: x\nscale: -1", "line 2, column 1: scale: -1 should be greater than 0"),
        ("title: x\nscale:", "line 2, column 1: scale: an empty value should be a valid number"),
        ("title: x\ntilt_rad: 1e999", "line 2, column 1: tilt_rad: inf should be a finite number"),
        ("title: x\ncolour: green", "line 2, column 1: colour: 'green' should be 'red' or 'blue'"),
        ("title: x\ncorner: [1, x]", "line 2, column 1: corner.1: 'x' should be a valid number"),
        (
            "title: x\ncircles: [{kind: circle, radius_m: 0}]",
            "line 2, column 26: circles.0.radius_m: 0 should be greater than 0",
        ),
        (
            "title: x\nnamed:\n  sun: {kind: circle}",
            "line 3, column 3: named.sun.radius_m is missing",
        ),
        (
            "title: x\nshape: {kind: square}",
            "line 2, column 1: shape.kind: 'square' is not one of 'circle', 'line'",
        ),
        (
            "title: x\nnamed:",
            "line 2, column 1: named: an empty value should be a mapping of keys to values",
        ),
        ("title: x\ncorners: [[0, 0], [1]]", "line 2, column 1: corners.1.1 is missing"),
        (
            "title: x\ncorners: [[0, 0]]",
            "line 2, column 1: corners: [[0, 0]] should have at least 2 items, not 1",
        ),
        (
            "title: x\nshape: {kind: line, point: 3}",
            "line 2, column 1: shape.points is missing\n"
            "line 2, column 21: shape.point is not a known key",
        ),
        ("title: x\ncircles: circle", "line 2, column 1: circles: 'circle' should be a list"),
        ("title: x\nzzz: 3", f"line 2, column 1: zzz is not a known key (known keys: {KEYS})"),
        ("title: x\ncolour: blue\ntilt_rad: 1", "d.yaml: a blue drawing is not tilted"),
        # YAML that is not accepted
        (
            "title: [1",
            "line 1, column 10: expected ',' or ']', but got '<stream end>'"
            "; check indentation, colons and quotes",
        ),
        ("title: x\ntitle: y", "line 2, column 1: the key 'title' is given twice"),
        ("- a\n- b", "d.yaml: expected a mapping of keys to values, not ['a', 'b']"),
        ("title: &t x\ncolour: *t", "line 2, column 9: aliases and tags are not allowed"),
        (
            "title: !!python/name:os.system x",
            "line 1, column 8: aliases and tags are not allowed",
        ),
        ("? [1, 2]\n: 3", "line 1, column 3: a key must be a single word"),
        (
            "a: 1\n---\nb: 2",
            "line 2, column 1: expected a single document in the stream, "
            "but found another document",
        ),
        ("[" * 1000, "d.yaml: nested too deeply"),
    ],
)
def test_each_problem_is_one_sentence_with_its_place(text: str, sentence: str) -> None:
    place = "" if sentence.startswith("d.yaml") else "d.yaml, "
    assert problems(text) == tuple(place + line for line in sentence.splitlines())


def test_description_is_read_but_not_part_of_the_value() -> None:
    text = "description: a drawing\ntitle: x"
    assert parse(text, Drawing, "d.yaml") == Drawing(title="x")
    assert read(text, "d.yaml").description == "a drawing"
    assert read("title: x", "d.yaml").description == ""
    for wrong in ("3", "[a, b]", "x" * 201):
        (problem,) = problems(f"description: {wrong}\ntitle: x")
        assert problem.startswith("d.yaml: description: ")
        assert problem.endswith("should be text of at most 200 characters")


def test_override_changes_a_copy() -> None:
    raw = read("title: x\nshape: {kind: line, points: 3}\ncorner: [1, 2]", "d.yaml")
    changed = override(override(raw, "shape.points=4"), "corner.1=1e-1")
    changed = override(changed, "named.sun={kind: circle, radius_m: 2}")
    drawing = validate(changed, Drawing, "d.yaml")
    assert drawing.shape == Line(kind="line", points=4)
    assert drawing.corner == (1.0, 0.1)
    assert drawing.named["sun"].radius_m == 2.0
    assert raw == {"title": "x", "shape": {"kind": "line", "points": 3}, "corner": [1, 2]}


def test_bad_override_is_refused() -> None:
    raw = read("title: x\ncorner: [1, 2]", "d.yaml")
    assert override(raw, "title=a=b")["title"] == "a=b"
    for assignment, sentence in (
        (
            "scal=2",
            f"--set scal=2: scal is not a known key, did you mean scale? (known keys: {KEYS})",
        ),
        ("corner.5=2", "--set corner.5=2: '5' is no index of a list of 2 values, counted from 0"),
        ("corner.0=x", "--set corner.0=x: corner.0: 'x' should be a valid number"),
        ("scale=12", "--set scale=12: scale: 12 should be less than 10"),
        ("scale", "--set scale: expected key.path=value"),
        ("a..b=3", "--set a..b=3: expected key.path=value"),
    ):
        with pytest.raises(DocumentError) as caught:
            validate(override(raw, assignment), Drawing, "d.yaml")
        assert caught.value.problems == (sentence,)


@given(st.text(st.sampled_from("ab:-[]{}&*!?|>'\"%@#,.0123 \n\t\\\x00\ud800é~"), max_size=40))
def test_every_text_is_read_or_raises_document_error(text: str) -> None:
    refused: tuple[str, ...] = ()
    title: object = None
    try:
        title = parse(text, Drawing, "fuzz").title
    except DocumentError as error:
        refused = error.problems
    assert bool(refused) != bool(title)
    assert all(problem.startswith("fuzz") for problem in refused)


# --- key files of MAVLink 2 signing ---------------------------------------------------------------


SECRET = "0123456789abcdef" * 4


def written(path: Path, text: str, mode: int = 0o600) -> Path:
    path.write_text(text)
    path.chmod(mode)
    return path


def test_new_key_is_private_random_and_a_passphrase_hash(tmp_path: Path) -> None:
    before = os.umask(0o777)  # the most restrictive umask
    try:
        passphrases = [create_key(tmp_path / name) for name in "ab"]
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o600
    assert passphrases[0] != passphrases[1]
    assert all(len(bytes.fromhex(each)) == 32 for each in passphrases)
    key = hashlib.sha256(passphrases[0].encode()).digest()
    assert read_key(tmp_path / "a") == key
    with pytest.raises(UserError, match="exists and is not replaced"):
        create_key(tmp_path / "a")
    assert read_key(tmp_path / "a") == key


def test_incomplete_key_file_is_removed(tmp_path: Path) -> None:
    with full_disk(20), pytest.raises(UserError, match="cannot be created: File too large"):
        create_key(tmp_path / "key")
    assert not (tmp_path / "key").exists()


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (f"# mine\n\nkey: {SECRET}\n", bytes.fromhex(SECRET)),
        (f"key:{SECRET.upper()}", bytes.fromhex(SECRET)),
        ("passphrase: sixteen letters!", hashlib.sha256(b"sixteen letters!").digest()),
        ("passphrase: a: b, c and d: e\r\n", hashlib.sha256(b"a: b, c and d: e").digest()),
    ],
)
def test_key_and_passphrase_files_are_read(text: str, key: bytes, tmp_path: Path) -> None:
    assert read_key(written(tmp_path / "key", text)) == key


@pytest.mark.parametrize(
    "text",
    [
        "",
        SECRET,
        f"key: {SECRET[:-1]}",
        f"key: {SECRET}0",
        f"key: {SECRET[:-1]}g",
        f"key: {'0' * 64}",
        f"key: {SECRET}\nkey: {SECRET}",
        "passphrase: fifteen letters",
        f"secret: {SECRET}",
        "key: \xff",
    ],
)
def test_invalid_key_is_refused_without_showing_it(text: str, tmp_path: Path) -> None:
    with pytest.raises(UserError) as refused:
        read_key(written(tmp_path / "key", text))
    sentence = str(refused.value)
    assert "too short or no key file" in sentence
    assert len(sentence.splitlines()) == 1
    assert not any(each in sentence for each in (SECRET, SECRET[:-1], "fifteen letters"))


def test_key_file_must_be_private_and_regular(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo", 0o600)
    large = written(tmp_path / "large", "#" * (SIZE_MOST + 1))
    modes = (0o640, 0o604, 0o620, 0o601)
    shared = [written(tmp_path / f"{mode:o}", f"key: {SECRET}", mode) for mode in modes]
    for path, reason in (
        *((path, "by other users: chmod 600 it") for path in shared),
        (tmp_path, "not a regular file"),
        (tmp_path / "fifo", "not a regular file"),
        (tmp_path / "none", "No such file"),
        (large, "larger than 500 kB"),
        (Path("a\0b"), "cannot be read"),
    ):
        with pytest.raises(UserError, match=reason):
            read_key(path)
