"""Logs from text tables and from .npz: columns, units, exact times, damaged rows."""

from __future__ import annotations

import gzip
import pickle
import zipfile
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from palpate.errors import InputError, LogError
from palpate.logs import ColumnMap, Log, SignalColumns, npz, table
from palpate.logs.table import exact_ns, number
from recordings import data_folder

HEADER = "time_ns,position_1,position_2,velocity_1,velocity_2,effort_1,effort_2\n"
TWO = ColumnMap(time=0, time_unit="s", position=(1, 2), effort=(3, 4))


def rows(count: int, start: int = 0) -> str:
    return "".join(f"{k * 1000},{k}.5,-{k}.25,0.1,0.2,{k},1e-3\n" for k in range(start, start + count))


def write(tmp_path: Path, text: str | bytes, name: str = "log.csv") -> Path:
    path = tmp_path / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


# -- columns ----------------------------------------------------------------------------------------------------------


def test_palpates_own_column_names_need_no_map(tmp_path):
    log = Log.open(write(tmp_path, HEADER + rows(5)))
    assert log.joint_names == ("joint_1", "joint_2")
    np.testing.assert_array_equal(log.time_ns, np.arange(5) * 1000)
    np.testing.assert_array_equal(log.position, [[k + 0.5, -k - 0.25] for k in range(5)])
    np.testing.assert_array_equal(log.velocity, [[0.1, 0.2]] * 5)
    np.testing.assert_array_equal(log.effort[:, 1], [1e-3] * 5)
    assert log.model_torque is None
    assert log.repair.clean
    assert log.repair.rows_read == 5
    assert Log.open(write(tmp_path, HEADER + rows(5)), joints=["joint_2"]).position[0, 0] == -0.25


def test_no_header_columns_by_index_units_and_signals(tmp_path):
    text = "".join(f"{0.5 * k:.3f};{90 * k};180;{1500 * k};-250;7;8;9\n" for k in range(4))
    columns = ColumnMap(
        time=0,
        position=range(1, 3),
        position_unit="deg",
        effort=[3, 4],
        effort_unit="mA",
        joint_names=["shoulder", "elbow"],
        signals={"force": SignalColumns(range(5, 8), "kN", 1e-3), "last": 7},
    )
    log = Log.open(write(tmp_path, text), columns)
    assert log.joint_names == ("shoulder", "elbow")
    np.testing.assert_array_equal(log.time_ns, np.arange(4) * 500_000_000)
    np.testing.assert_allclose(log.position[1], [np.pi / 2, np.pi])
    np.testing.assert_allclose(log.effort[2], [3.0, -0.25])
    assert log.meta == {"effort_unit": "A"}
    np.testing.assert_allclose(log.signals["force"].value[0], [7e-3, 8e-3, 9e-3])
    assert log.signals["force"].unit == "kN"
    assert log.signals["last"].value.shape == (4,)


@pytest.mark.parametrize(
    ("field", "unit", "factor"),
    [
        ("position", "rev", 2 * np.pi),
        ("position", "mrad", 1e-3),
        ("position", "mm", 1e-3),
        ("position", 2 * np.pi / 4096, 2 * np.pi / 4096),
        ("velocity", "rpm", np.pi / 30),
        ("velocity", "deg/s", np.pi / 180),
        ("effort", "mNm", 1e-3),
        ("effort", "kgf cm", 0.0980665),
        ("effort", "raw", 1.0),
        ("model_torque", "mN m", 1e-3),
    ],
)
def test_units(tmp_path, field, unit, factor):
    columns = ColumnMap(time=0, position=1, velocity=2, effort=3, model_torque=4, **{f"{field}_unit": unit})
    log = Log.open(write(tmp_path, "0,2,2,2,2\n1,4,4,4,4\n"), columns)
    for name in ("position", "velocity", "effort", "model_torque"):
        expected = np.array([[2.0], [4.0]]) * (factor if name == field else 1.0)
        np.testing.assert_allclose(getattr(log, name), expected, rtol=1e-15)


def test_patterns(tmp_path):
    text = "t,wrist_pos,elbow_pos,ft_10,ft_2,elbow_I,wrist_I\n1,2,3,4,5,6,7\n2,2,3,4,5,6,7\n"
    columns = ColumnMap(time="t", position="{joint}_pos", effort="{joint}_I", signals={"ft": "ft_{i}"})
    log = Log.open(write(tmp_path, text), columns)
    assert log.joint_names == ("wrist", "elbow")
    np.testing.assert_array_equal(log.effort[0], [7, 6])
    np.testing.assert_array_equal(log.signals["ft"].value[0], [5, 4])  # ft_2 before ft_10
    ordered = ColumnMap(time="t", position="{joint}_pos", joints=("elbow", "wrist"))
    assert Log.open(write(tmp_path, text), ordered).joint_names == ("elbow", "wrist")


def test_a_missing_column_is_named_with_its_neighbours(tmp_path):
    path = write(tmp_path, "time,joint_pos_1,joint_pos_2,load_1\n1,2,3,4\n2,3,4,5\n")
    with pytest.raises(
        LogError, match="no column 'joint_pos1' for position; close to it: joint_pos_1, joint_pos_2"
    ):
        Log.open(path, ColumnMap(position=["joint_pos1"]))
    with pytest.raises(
        LogError, match=r"no column like 'pos_\{joint\}' for position; close to it: joint_pos_1"
    ):
        Log.open(path, ColumnMap(position="pos_{joint}"))
    with pytest.raises(LogError, match="no column 9 for effort; there are 4, counted from 0 to 3"):
        Log.open(path, ColumnMap(position=1, effort=9))
    with pytest.raises(LogError, match="2 columns of position but 1 of effort"):
        Log.open(path, ColumnMap(position=(1, 2), effort=[3]))
    with pytest.raises(LogError, match="the file has no header"):
        Log.open(write(tmp_path, "1,2,3,4\n1,2,3,4\n", "bare.csv"), ColumnMap(position="joint_{joint}"))
    with pytest.raises(LogError, match="must have the columns time_ns .or time_s., position_1"):
        Log.open(path)
    with pytest.raises(LogError, match="placeholder"):
        Log.open(path, ColumnMap(position="joint_pos_{k}"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"time_unit": "min"}, "time_unit must be one of s, ms, us"),
        ({"position_unit": "grad"}, "position_unit must be one of rad, mrad, deg, .* got 'grad'"),
        ({"effort_unit": 0.0}, "not 0"),
        ({"time": None}, "the period .s. must be given"),
        ({"delimiter": "ab"}, "one character"),
        ({"signals": {"a": SignalColumns("x", scale=float("nan"))}}, "scale of signal 'a'"),
    ],
)
def test_a_wrong_map_is_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        ColumnMap(position="q{joint}", **arguments)


def test_named_maps_are_listed():
    assert "lara8" in ColumnMap.names()
    with pytest.raises(InputError, match="no column map named 'lara'; there are lara8"):
        ColumnMap.named("lara")


# -- text -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        HEADER.encode("utf-8-sig") + rows(5).encode(),
        (HEADER + rows(5)).replace("\n", "\r\n").encode(),
        (HEADER + rows(5)).replace("\n", "\r").encode(),
        (HEADER + rows(5)).replace(",", "\t").encode(),
        (HEADER + rows(5)).replace(",", ";").encode(),
        (HEADER + rows(5)).replace(",", "   ").encode(),
        (HEADER + rows(5)).replace(",", " , ").encode(),
        ("# a comment, with a comma\n# " + HEADER + rows(5)).encode(),
        ("\n\n" + HEADER + "\n" + rows(3) + "# pause\n" + rows(2, 3) + "\n").encode(),
        (HEADER + rows(5).replace("\n", ",\n")).encode(),
        (",".join(f'"{name}"' for name in HEADER.strip().split(",")) + "\n" + rows(5)).encode(),
        (HEADER + rows(5).replace(",0.1,", ',"0.1",')).encode(),
        gzip.compress((HEADER + rows(5)).encode()),
        gzip.compress((HEADER + rows(2)).encode()) + gzip.compress(rows(3, 2).encode()) + bytes(512),
    ],
    ids=(
        "bom crlf cr tab semicolon blanks padded comments gaps trailing quoted-names quoted-cells gzip members"
    ).split(),
)
def test_every_dialect_gives_the_same_log(tmp_path, text):
    expected = Log.open(write(tmp_path, HEADER + rows(5)))
    path = write(tmp_path, text, "other.csv.gz" if text.startswith(b"\x1f\x8b") else "other.csv")
    log = Log.open(path)
    assert log == expected
    assert log.repair.clean


def test_damaged_rows_are_dropped_and_counted(tmp_path):
    good = rows(1000).splitlines()
    bad = {
        3: "abc,1,1,1,1,1,1",
        10: "10000,1,1,x,1,1,1",
        11: "11000,1,1,1,1",
        12: "12000,1,1,1,1,1,1,1",
        500: "500000,nan,1,1,1,1,1",
        501: "501000,1,1,inf,1,1,1",
        502: "502000,1e250,1,1,1,1,1",
        503: "503000,1000001,1,1,1,1,1",
        504: "504000,1,1,1,1,-1e10,1",
        505: "505000,1,,1,1,1,1",
        506: "nan,1,1,1,1,1,1",
        507: "99999999999999999999,1,1,1,1,1,1",
        700: "700000,1,1,1_0,1,1,1",
        800: "\x00\x7f\ufffd",
    }
    for k, line in bad.items():
        good[k] = line
    log = Log.open(write(tmp_path, HEADER + "\n".join(good) + "\n"))
    assert len(log) == 1000 - len(bad)
    assert set(bad) == set(range(1000)) - set((log.time_ns // 1000).tolist())
    assert dict(log.repair.dropped) == {
        "unreadable time": 3,
        "wrong number of columns": 3,
        "cell that is not a number": 2,
        "NaN or infinite value": 3,
        "absurd value (position beyond 1e6 or other beyond 1e9)": 3,
    }
    # lines of the file, the header being the first
    assert log.repair.lines["unreadable time"] == (5, 508, 509)
    assert log.repair.lines["wrong number of columns"] == (13, 14, 802)
    assert log.repair.rows_read == 1000
    assert f"{len(bad)} dropped" in repr(log)


def test_invalid_rows_can_be_kept_in_place(tmp_path):
    text = HEADER + rows(2) + "2000,nan,1e300,x,1,1,1\n" + rows(2, 3) + "5000,1\n"
    log = Log.open(write(tmp_path, text), keep_invalid=True)
    np.testing.assert_array_equal(log.time_ns, np.arange(5) * 1000)
    assert np.isnan(log.position[2, 0])
    assert log.position[2, 1] == 1e300
    assert np.isnan(log.velocity[2, 0])
    # a cut row would be a guess: it goes in any case
    assert dict(log.repair.dropped) == {"wrong number of columns": 1}
    assert any("kept, as asked: 1 rows" in note for note in log.repair.notes)


def test_a_signal_loses_its_bad_values_alone(tmp_path):
    text = "t,q1,i1,f\n0,1,1,5\n1,1,1,\n2,1,1,nan\n3,1,1,1e250\n4,1,1,oops\n5,1,1,6\n"
    columns = ColumnMap(time="t", position="q{joint}", effort="i{joint}", signals={"f": "f"})
    log = Log.open(write(tmp_path, text), columns)
    assert len(log) == 6
    np.testing.assert_array_equal(log.signals["f"].value, [5, 6])
    np.testing.assert_array_equal(log.signals["f"].time_ns, [0, 5_000_000_000])
    assert log.repair.dropped["signal f: NaN, infinite or beyond 1e9"] == 4
    assert len(Log.open(write(tmp_path, text), columns, keep_invalid=True).signals["f"]) == 6


def test_an_empty_column_is_a_missing_quantity(tmp_path):
    text = "t,q1,v1,i1\n0,1,,nan\n1,2,,nan\n"
    columns = ColumnMap(time="t", position="q{joint}", velocity="v{joint}", effort="i{joint}")
    log = Log.open(write(tmp_path, text), columns)
    assert len(log) == 2
    assert log.velocity is None
    assert not log.has_effort
    assert log.repair.notes == ("velocity is empty in every row", "effort is empty in every row")


def test_no_effort_column(tmp_path):
    log = Log.open(write(tmp_path, "0,1\n1,2\n"), ColumnMap(time=0, position=1))
    assert not log.has_effort
    assert log.effort.shape == (2, 1)
    assert log.meta == {}


def test_backward_and_repeated_times_stay_in_order(tmp_path):
    log = Log.open(write(tmp_path, "0.3,1,1,1,1\n0.1,2,2,2,2\n0.1,3,3,3,3\n0.2,4,4,4,4\n"), TWO)
    np.testing.assert_array_equal(log.position[:, 0], [1, 2, 3, 4])
    assert (log.repair.clock.backwards, log.repair.clock.repeated) == (1, 1)
    assert not log.repair.dropped


def test_one_row(tmp_path):
    log = Log.open(write(tmp_path, HEADER + rows(1)))
    assert len(log) == 1
    assert log.rate == 0.0


def test_a_last_line_without_end_is_noted(tmp_path):
    log = Log.open(write(tmp_path, (HEADER + rows(5)).rstrip("\n")))
    assert len(log) == 5
    assert log.repair.notes == ("the last line (6) has no line end; it may be cut short",)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (b"", "the file is empty"),
        (b"\n\n", "no rows of numbers"),
        (b"# nothing\n", "only comments"),
        (HEADER.encode(), "no rows of numbers"),
        (
            (HEADER + "x,1,1,1,1,1,1\n").encode(),
            "none of 1 rows is usable: 1 with unreadable time .first at 2.",
        ),
        ((HEADER + "1,a,1,1,1,1,1\n").encode(), "1 with cell that is not a number"),
        (b"time_ns,position_1,effort_1\n1,2,3,4\n2,3,4,5\n", "names 3 columns, but the rows have 4"),
        (HEADER.encode("utf-16"), "UTF-16"),
        (b"\x89MCAP0\r\n", "an MCAP file; name it .mcap"),
        (b"SQLite format 3\0", "name it .db3"),
        (b"PK\x03\x04", "a ZIP or NPZ file"),
        (b"1" * (3 << 20), "longer than 1 MiB"),
        (gzip.compress(bytes(16 << 20)), "longer than 1 MiB"),
    ],
    ids="empty blank comment header bad-time bad-cell widths utf16 mcap db3 zip one-line zeros".split(),
)
def test_files_that_are_no_table(tmp_path, text, message):
    with pytest.raises(LogError, match=message):
        Log.open(write(tmp_path, text))


def test_a_gzip_bomb_of_good_rows_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "EXPANSION_FREE", 1 << 20)
    packed = gzip.compress((HEADER + "1,0,0,0,0,0,0\n" * 400_000).encode())
    with pytest.raises(LogError, match="expands to more than"):
        Log.open(write(tmp_path, packed, "bomb.csv.gz"))


def test_a_cut_gzip_gives_what_was_there(tmp_path):
    whole = gzip.compress((HEADER + rows(3000)).encode())
    log = Log.open(write(tmp_path, whole[: len(whole) // 2], "cut.csv.gz"))
    assert 1000 < len(log) < 2500
    np.testing.assert_array_equal(log.time_ns, np.arange(len(log)) * 1000)
    assert any("cut short" in note for note in log.repair.notes)
    flipped = bytearray(whole)
    flipped[-5] ^= 1  # the checksum
    log = Log.open(write(tmp_path, bytes(flipped), "flip.csv.gz"))
    assert len(log) == 3000
    assert any("damaged" in note for note in log.repair.notes)


def test_a_period_replaces_the_time(tmp_path):
    columns = ColumnMap(time=None, period=2e-4, position=(0,), effort=(1,))
    text = "".join(f"{k},0\n" for k in range(10)).replace("4,0\n", "4,x\n").replace("6,0\n", "6\n")
    log = Log.open(write(tmp_path, text), columns)
    np.testing.assert_array_equal(log.time_ns, np.array([0, 1, 2, 3, 5, 7, 8, 9]) * 200_000)


# -- numbers ----------------------------------------------------------------------------------------------------------


def test_times_are_exact(tmp_path):
    text = "1700000000.123456789,1,1,1,1\n1700000000.1234567894,2,2,2,2\n1.7000000011e9,3,3,3,3\n"
    log = Log.open(write(tmp_path, text), TWO)
    np.testing.assert_array_equal(
        log.time_ns, [1_700_000_000_123_456_789, 1_700_000_000_123_456_789, 1_700_000_001_100_000_000]
    )
    log = Log.open(write(tmp_path, HEADER + "4611686018427387903,1,1,1,1,1,1\n-1,1,1,1,1,1,1\n"))
    np.testing.assert_array_equal(log.time_ns, [2**62 - 1, -1])
    for unit, value in (("ms", 1_500_000), ("us", 1_500), ("ns", 2)):
        columns = ColumnMap(time=0, time_unit=unit, position=1)
        assert Log.open(write(tmp_path, "1.5,0\n"), columns).time_ns[0] == value


@given(st.decimals(-4_000_000_000, 4_000_000_000, places=9), st.sampled_from([0, 3, 6, 9]))
def test_times_are_exact_for_any_digits(value, exponent):
    exact = int((value * Decimal(10) ** exponent).to_integral_value())
    for text in (str(value), f"{value:f}", f"{value:e}", f"  {value:+f} "):
        assert exact_ns(text, exponent) == exact


@pytest.mark.parametrize(
    "text", ["", "x", "1e99", "-1e99", "nan", "inf", "0x1", "1_0", "1e999999999", "5e18", "1 2"]
)
def test_no_time(text):
    assert exact_ns(text, 9) is None
    assert exact_ns("1e-999999999", 9) == 0


@given(st.floats())
def test_numbers_are_read_bit_for_bit(tmp_path_factory, value):
    assert np.float64(number(repr(value))).tobytes() == np.float64(float(repr(value))).tobytes()
    path = tmp_path_factory.getbasetemp() / "number.csv"
    path.write_text(f"0,{value!r}\n1,{value!r}\n")
    log = Log.open(path, ColumnMap(time=0, position=1), keep_invalid=True)
    assert log.position.tobytes() == np.array([float(repr(value))] * 2).tobytes()


@pytest.mark.parametrize(
    "text", ["1_0", "0x10", "1d5", "1e", "--1", "1.2.3", "nan(1)", "True", "１", "1L", "+ 1"]
)
def test_no_number(text):
    assert number(text) is None


# -- .npz -------------------------------------------------------------------------------------------------------------


def save(tmp_path: Path, **arrays: np.ndarray) -> Path:
    np.savez(tmp_path / "log.npz", **arrays)
    return tmp_path / "log.npz"


def test_npz_of_others(tmp_path):
    q = np.arange(12.0).reshape(4, 3)
    path = save(
        tmp_path,
        times=np.array([0.5, 1.0, 1.5, 2.0]),
        positions=np.asfortranarray(q),
        torques=(10 * q).astype(np.float32),
        force=np.arange(4),
        pickled=np.array([{}], dtype=object),
    )
    columns = ColumnMap(
        time="times", position="positions", position_unit="deg", effort="torques", signals={"f": "force"}
    )
    log = Log.open(path, columns)
    assert log.joint_names == ("joint_1", "joint_2", "joint_3")
    np.testing.assert_array_equal(log.time_ns, [500_000_000, 1_000_000_000, 1_500_000_000, 2_000_000_000])
    np.testing.assert_allclose(log.position, np.deg2rad(q))
    np.testing.assert_array_equal(log.effort, 10 * q)
    np.testing.assert_array_equal(log.signals["f"].value, np.arange(4))
    with pytest.raises(LogError, match="not written by palpate; .* arrays times, positions, torques"):
        Log.open(path)
    with pytest.raises(LogError, match="'pickled' holds object .a pickle or text.; expected numbers"):
        Log.open(path, ColumnMap(time="times", position="pickled"))
    with pytest.raises(LogError, match="have names, not indices"):
        Log.open(path, ColumnMap(time="times", position=0))
    with pytest.raises(LogError, match="no column 'position' for position; close to it: positions"):
        Log.open(path, ColumnMap(time="times", position="position"))
    with pytest.raises(LogError, match="do not fit"):
        Log.open(path, ColumnMap(time="positions", position="positions"))


def test_npz_one_array_per_joint_integer_times_and_bad_rows(tmp_path):
    path = save(
        tmp_path,
        t=np.array([3, 1, 2, 2], dtype=np.uint64) * 1_000_000_007,
        q_1=np.array([1.0, np.nan, 3.0, 4.0]),
        q_2=np.array([1.0, 2.0, 1e250, 4.0]),
    )
    columns = ColumnMap(time="t", time_unit="ns", position="q_{joint}")
    log = Log.open(path, columns)
    np.testing.assert_array_equal(log.time_ns, [3_000_000_021, 2_000_000_014])
    assert log.repair.lines["NaN or infinite value"] == (1,)
    assert len(Log.open(path, columns, keep_invalid=True)) == 4
    big = save(tmp_path, t=np.array([1, 2**63 - 1]), q=np.ones(2))
    log = Log.open(big, ColumnMap(time="t", time_unit="ns", position="q"))
    assert log.repair.dropped == {"unreadable time": 1}


def test_npz_bombs_and_pickles(tmp_path, monkeypatch):
    monkeypatch.setattr(npz, "_EXPANSION_FREE", 1 << 20)

    class Bomb:
        def __reduce__(self):
            return (pytest.fail, ("a pickle was run",))

    columns = ColumnMap(time="t", position="q")
    header = b"\x93NUMPY\x01\x00\x76\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }"
    cases = {
        "pickle": (pickle.dumps(Bomb()), "is damaged"),
        "shape": ((header % 10**15).ljust(127) + b"\n" + bytes(80), "80 bytes for"),
        "zeros": ((header % (2 << 20)).ljust(127) + b"\n" + bytes(16 << 20), "too much for its file"),
        "nested": (b"\x93NUMPY\x01\x00\xff\xff" + b"(" * 65535, "is damaged"),
    }
    for name, (content, message) in cases.items():
        path = tmp_path / f"{name}.npz"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("q.npy", content)
            archive.writestr("t.npy", content)
        with pytest.raises(LogError, match=message):
            Log.open(path, columns)


# -- a real robot -----------------------------------------------------------------------------------------------------


def test_lara8():
    folder = data_folder() / "lara8_neura_ft"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there")
    log = Log.open(folder / "jogging_linear_mass.csv", ColumnMap.named("lara8"))
    assert len(log) == 1247
    assert log.n == 6
    assert log.repair.clean
    assert log.time_ns[0] == 3_420_464_485_295  # "3420.464485295" in the file
    assert log.rate == pytest.approx(250.0, rel=1e-3)
    np.testing.assert_array_equal(log.position[0, :2], [1.16369, 0.00258709])
    np.testing.assert_array_equal(log.effort[0, :2], [7.64475, -80.4228])
    np.testing.assert_array_equal(log.model_torque[0, 1:3], [-52.0744, -55.2717])
    # the truth that came with it: 51.62 N hang from the sensor, and the current shows -36.2 N m on joint 2
    force = log.signals["fts_reading"].value[:, :3]
    assert np.linalg.norm(force, axis=1).mean() == pytest.approx(51.62, abs=0.05)
    assert (log.effort - log.model_torque)[:, 1].mean() == pytest.approx(-36.16, abs=0.05)
    assert log.signals["pose"].value.shape == (1247, 7)
    with pytest.raises(LogError, match="--columns lara8"):
        Log.open(folder / "jogging_final.csv")


def test_recordings_without_header(tmp_path):
    path = data_folder() / "ur10e_innopolis" / "collision_detection_data" / "collision_free.csv"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    columns = ColumnMap(
        time=0, position=range(1, 7), velocity=range(7, 13), effort=range(13, 19), effort_unit="A"
    )
    log = Log.open(path, columns)
    assert log.n == 6
    assert len(log) > 1000
    assert log.meta["effort_unit"] == "A"
