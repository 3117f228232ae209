"""The tape as a file: what is written comes back; what is damaged is refused in a sentence."""

import io
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from fixtures_core import refused

from jumplab.errors import InputError
from jumplab.io.tape import SCHEMA, Tape

N = 6


def make_tape(**other) -> Tape:
    rng = np.random.default_rng(1)
    arrays = dict(
        t=np.array([0, 1, 2, 2, 3, 4]) / 1e3, q=rng.normal(size=(N, 21)), v=rng.normal(size=(N, 20)),
        a=rng.normal(size=(N, 20)), tau=rng.normal(size=(N, 14)), phase=np.array(["launch"] * 3 + ["flight"] * 3),
        contact_frames=np.array(["left_foot", "right_foot"]), f=rng.normal(size=(N, 2, 6)),
        joint_names=np.array([f"joint {i}" for i in range(14)]), extra={"planar_com": rng.normal(size=(N, 2))},
    )  # fmt: skip
    return Tape(**(arrays | other))


def test_takeoff_appears_twice():
    tape = make_tape()
    assert tape.takeoff_index == 3 and tape.takeoff_time == 0.002


def test_immutable(tmp_path):
    tape = make_tape()
    tape.save(tmp_path / "plan.npz")
    for one in (tape, Tape.load(tmp_path / "plan.npz")):
        with pytest.raises(FrozenInstanceError):
            one.t = np.zeros(N)
        for name, x in one.arrays().items():
            if name != "schema":
                assert not x.flags.writeable, name


SHAPES = [({name: slice(-1)}, f"{name} has 5 rows, t has 6") for name in ("q", "v", "a", "tau", "phase", "f")]
SHAPES += [({"t": 0}, "t has 0 dimensions, needs 1"), ({"f": (slice(None), 0)}, "f has 2 dimensions, needs 3")]


@pytest.mark.parametrize(("part", "sentence"), SHAPES)
def test_shapes_must_agree(part, sentence):
    said = refused(make_tape, **{name: getattr(make_tape(), name)[rows] for name, rows in part.items()})
    assert said == f"tape: {sentence}"


def test_missing_file(tmp_path):
    said = refused(Tape.load, tmp_path / "plan.npz")
    assert said == f"{tmp_path / 'plan.npz'}: no such plan; write one with 'jumplab plan --out {tmp_path}'"
    with pytest.raises(InputError, match="no such plan"):
        Tape.load(tmp_path)  # a folder is not a plan


def test_truncated_anywhere(tmp_path):
    path = tmp_path / "plan.npz"
    make_tape().save(path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 37):
        path.write_bytes(whole[:length])
        said = refused(Tape.load, path)
        assert said.startswith(f"{path}: ") and "\n" not in said


def test_one_altered_byte_anywhere(tmp_path):
    """Either the file still says the same, or it is refused; never another error, never other numbers."""
    path, tape = tmp_path / "plan.npz", make_tape()
    tape.save(path)
    whole, refused = path.read_bytes(), 0
    for at in range(0, len(whole), 11):
        altered = bytearray(whole)
        altered[at] ^= 0xFF
        path.write_bytes(altered)
        try:
            back = Tape.load(path)
        except InputError:
            refused += 1
        else:
            np.testing.assert_array_equal(back.q, tape.q)
    assert refused > len(whole) / 11 / 2


def single_array() -> bytes:
    file = io.BytesIO()
    np.save(file, np.zeros(3))
    return file.getvalue()


@pytest.mark.parametrize("text", [b"", b"hello", b"\x93NUMPY\x01\x00garbage", single_array()])
def test_not_an_archive(tmp_path, text):
    (tmp_path / "plan.npz").write_bytes(text)
    assert "not a readable plan" in refused(Tape.load, tmp_path / "plan.npz")


SCHEMAS = f"schema {{!r}}, this version reads {SCHEMA!r}; plan the jump again"
OBJECTS = np.array([{}] * N, dtype=object)


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("q", OBJECTS, "not a readable plan (ValueError); it may be truncated"),
        ("schema", np.array("jumplab-plan-0"), SCHEMAS.format("jumplab-plan-0")),
        ("schema", None, SCHEMAS.format("none")),
        *((name, None, f"the array {name!r} is missing; plan the jump again") for name in ("t", "tau", "joint_names")),
    ],
)
def test_foreign_arrays_are_refused(tmp_path, name, value, sentence):
    path, arrays = tmp_path / "plan.npz", make_tape().arrays() | {name: value}
    np.savez(path, **{k: x for k, x in arrays.items() if x is not None})
    assert refused(Tape.load, path) == f"{path}: {sentence}"
