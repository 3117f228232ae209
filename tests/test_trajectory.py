"""The tape as a file: what is written comes back; what is damaged is refused in a sentence."""

import io
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

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


def test_round_trip(odd_folder):
    tape, path = make_tape(), odd_folder / "plan.npz"
    tape.save(path)
    back = Tape.load(path)
    assert back.arrays().keys() == tape.arrays().keys()
    for name, x in tape.arrays().items():
        assert x.dtype == back.arrays()[name].dtype
        np.testing.assert_array_equal(x, back.arrays()[name])


def test_file_needs_no_pickle_and_says_its_schema(tmp_path):
    make_tape().save(tmp_path / "plan.npz")
    with np.load(tmp_path / "plan.npz", allow_pickle=False) as file:
        assert str(file["schema"]) == SCHEMA
        assert {"t", "q", "v", "a", "tau", "phase", "contact_frames", "f", "joint_names"} < set(file.files)
        assert all(file[k].dtype != object for k in file.files)


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


@pytest.mark.parametrize("name", ["q", "v", "a", "tau", "phase", "f"])
def test_rows_must_agree(name):
    short = getattr(make_tape(), name)[:-1]
    with pytest.raises(InputError) as e:
        make_tape(**{name: short})
    assert str(e.value) == f"tape: {name} has 5 rows, t has 6"


def test_dimensions_must_fit():
    with pytest.raises(InputError) as e:
        make_tape(t=np.array(3.0))
    assert str(e.value) == "tape: t has 0 dimensions, needs 1"
    with pytest.raises(InputError, match=r"^tape: f has 2 dimensions, needs 3$"):
        make_tape(f=np.zeros((N, 6)))


def test_missing_file(tmp_path):
    with pytest.raises(InputError) as e:
        Tape.load(tmp_path / "plan.npz")
    assert str(e.value) == f"{tmp_path / 'plan.npz'}: no such plan; write one with 'jumplab plan --out {tmp_path}'"
    with pytest.raises(InputError, match="no such plan"):
        Tape.load(tmp_path)  # a folder is not a plan


def test_truncated_anywhere(tmp_path):
    path = tmp_path / "plan.npz"
    make_tape().save(path)
    whole = path.read_bytes()
    for length in range(0, len(whole), 37):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError) as e:
            Tape.load(path)
        assert str(e.value).startswith(f"{path}: ") and "\n" not in str(e.value)


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
    with pytest.raises(InputError, match="not a readable plan"):
        Tape.load(tmp_path / "plan.npz")


def test_objects_are_refused(tmp_path):
    np.savez(tmp_path / "plan.npz", **(make_tape().arrays() | {"q": np.array([{}] * N, dtype=object)}))
    with pytest.raises(InputError) as e:
        Tape.load(tmp_path / "plan.npz")
    assert str(e.value) == f"{tmp_path / 'plan.npz'}: not a readable plan (ValueError); it may be truncated"


@pytest.mark.parametrize("schema", ["jumplab-plan-0", "something"])
def test_other_schema(tmp_path, schema):
    np.savez(tmp_path / "plan.npz", **(make_tape().arrays() | {"schema": np.array(schema)}))
    with pytest.raises(InputError) as e:
        Tape.load(tmp_path / "plan.npz")
    assert str(e.value) == (
        f"{tmp_path / 'plan.npz'}: schema {schema!r}, this version reads {SCHEMA!r}; plan the jump again"
    )


@pytest.mark.parametrize("name", ["t", "tau", "joint_names", "schema"])
def test_missing_array(tmp_path, name):
    arrays = make_tape().arrays()
    del arrays[name]
    np.savez(tmp_path / "plan.npz", **arrays)
    with pytest.raises(InputError) as e:
        Tape.load(tmp_path / "plan.npz")
    want = f"schema 'none', this version reads {SCHEMA!r}; plan the jump again"
    assert str(e.value) == f"{tmp_path / 'plan.npz'}: " + (
        want if name == "schema" else f"the array {name!r} is missing"
    )
