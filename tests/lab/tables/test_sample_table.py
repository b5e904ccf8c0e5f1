"""The reader of tables: separators, decimal marks, empty values, and malformed rows by line number."""

from contextlib import nullcontext

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from flexneedle.errors import InputError
from flexneedle.lab.tables.columns import map_columns
from flexneedle.lab.tables.row_rules import POSITIONS, require_numbers, require_text
from flexneedle.lab.tables.sample_table import open_table
from flexneedle.lab.tables.write import write_table

COMMAS, SEMICOLONS = "sensor,x_mm,y_mm\n", "sensor;x_mm;y_mm\n"
ONE = [("a", 1.0, 2.0)]


def read(path, rules=(), mapping=None):
    with open_table(path, ("sensor", "x_mm", "y_mm"), ("z_mm",), mapping=mapping) as table:
        table.refuse(rules)
        found = table.arrays("SELECT sensor, x_mm, y_mm, z_mm FROM samples")
    assert np.isnan(found.pop("z_mm").astype(float)).all()
    return [
        tuple(None if value != value else value for value in row) for row in zip(*found.values(), strict=True)
    ]


@pytest.fixture
def written(tmp_path):
    """Return a function that writes a file from text or bytes."""

    def write(text):
        path = tmp_path / "table.csv"
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path

    return write


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        (COMMAS + "a,1,2\n", ONE),
        (COMMAS + "a,1,2", ONE),
        (SEMICOLONS + "a;1;2\n", ONE),
        ("sensor\tx_mm\ty_mm\na\t1\t2\n", ONE),
        ("\ufeff" + COMMAS + "a,1,2\n", ONE),
        ("\ufeffsep=;\r\nsensor;x_mm;y_mm\r\na;1;2\r\n", ONE),
        ("# a, comment\n\n#another\n" + COMMAS + "a,1,2\n", ONE),
        ("other,y_mm, sensor ,x_mm\n!,2,a,1\n", ONE),
        (COMMAS + '"a","1","2"\n', ONE),
        (COMMAS + " a , 1 ,+2e0\n\n\n", ONE),
        (SEMICOLONS + "a;1,5;-2,5e-1\n", [("a", 1.5, -0.25)]),
        (SEMICOLONS + "a;1.5;2\n", [("a", 1.5, 2.0)]),
        (SEMICOLONS + '"a;b";"1,5";2\n', [("a;b", 1.5, 2.0)]),
        ("sensor\tx_mm\ty_mm\na\t,5\t2\n", [("a", 0.5, 2.0)]),
        (COMMAS + "a,,NaN\na,NA,NAN\na,null,None\na,N/A,#N/A\na,MISSING, nan\n", [("a", None, None)] * 5),
        (
            COMMAS + 'a,na,Null\na,NONE,-\na,"--",#n/a\na,Missing,"NaN"\na,<NA>, NA \n',
            [("a", None, None)] * 5,
        ),
        (COMMAS + "a,1,2,\na,1,2,\n", ONE * 2),
        ("sensor,x_mm,y_mm,\na,1,2,\na,1,2,\n", ONE * 2),
        ("sensor,x_mm,y_mm,,\na,1,2\n", ONE),
        ("sensor, x_mm, y_mm\n" + '"a", "1", "2"\n', ONE),
        (COMMAS + "a,1,2\r\na,1,2\na,1,2\r", ONE * 3),
        (COMMAS.replace("\n", "\r") + "a,1,2\ra,1,2\r", ONE * 2),
        (COMMAS.replace("\n", "\r\n") + "a,1,2\r\n\r\na,1,2", ONE * 2),
        (COMMAS + "a,1,2\n   \n", ONE),
        (("\ufeff" + SEMICOLONS + "a;1;2\n").encode("utf-16-le"), ONE),
        (("\ufeff" + SEMICOLONS + "a;1;2\n").encode("utf-16-be"), ONE),
        ("% of MATLAB\n// and C\n" + COMMAS + "a,1,2\n", ONE),
        ('"SEP=;"\n' + SEMICOLONS + "a;1;2\n", ONE),
        ("sensor x_mm  y_mm\n a  1   2 \na 1 2\n", ONE * 2),
        (SEMICOLONS + "a;1;2\n" * 2000 + "a;1,25;2\n", [*ONE * 2000, ("a", 1.25, 2.0)]),
        (SEMICOLONS + "a;1,5;2.5\na;1,25;-.5\n", [("a", 1.5, 2.5), ("a", 1.25, -0.5)]),
        (SEMICOLONS + "a;1,500;2\n", [("a", 1.5, 2.0)]),
        (COMMAS + "a,1,2\n# pause, then on\n//\n% \n #\na,1,2\n# end", ONE * 2),
        ("sensor|x_mm|y_mm\na|1,5|2\n", [("a", 1.5, 2.0)]),
        ("sep=|\nsensor | x_mm | y_mm\na | 1.5 | 2\n", [("a", 1.5, 2.0)]),
        (COMMAS + "a,-3.697314E28,-3.69731e+28\na,-3.697e28,-3.70E+28\n", [("a", None, None)] * 2),
        (b"# 20 \xb0C\nsensor,x_mm,y_mm,note\na,1,2,\xb5m\n", ONE),
    ],
)
def test_a_csv_file_is_read(written, text, rows):
    assert read(written(text)) == rows


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (COMMAS + "a,1\n", "line 2"),
        (COMMAS + "a,1,2,3\n", "line 2"),
        (COMMAS + "a,1,5,2\n", "line 2"),
        (COMMAS + "a,1,2\n#b,1,2\n", "line 3: is a comment or a row"),
        (COMMAS + "%b,1,2\n", "line 2: is a comment or a row"),
        (COMMAS + "a,1,2\n # b,1,2,3\n", "line 3: is a comment or a row"),
        (
            SEMICOLONS + "a;1.234;0,5\na;-12.345;0,7\n",
            "line 2: x_mm: points may be decimal or separate thousands",
        ),
        (COMMAS + "a,1,2\na,1,2,\n", "line 3: has more fields"),
        (COMMAS + "a,1,2,\na,1,2\n", "line 3: has fewer fields"),
        (COMMAS + "a,1,2,\na,1,2,5\n", "line 3: has more fields"),
        ("sensor,x_mm,y_mm,\na,1,2,5\n", "line 2: has more fields"),
        (COMMAS + "a,1,2\n" * 5000 + "a,1,2,5\n", "line 5002: has more fields"),
        (SEMICOLONS + "a;1,0;2,5\na;1,5\n", "line 3: has fewer fields"),
        ("\n#\n" + COMMAS + "\na,1,2\r\na,1\n", "line 6: has fewer fields"),
        (COMMAS + "a,1,2\n\n\nb,1,y\n", "line 5: y_mm: 'y'"),
        ("# 1\n# 2\n" + COMMAS + "a,x,2\n", "line 4: x_mm: 'x'"),
        (COMMAS + 'a,"1,5",2\n', "line 2: x_mm: '1,5'"),
        (COMMAS + "a,1 000,2\n", "line 2: x_mm"),
        (COMMAS + "a,0x10,2\n", "line 2: x_mm"),
        (COMMAS + "a,−1,2\n", "line 2: x_mm"),
        (COMMAS + "a,1_000,2\n", "line 2: x_mm: '1_000'"),
        (COMMAS + "a,+-1,2\n", "line 2: x_mm"),
        (COMMAS + 'a,"1,000",2\n', "line 2: x_mm"),
        (SEMICOLONS + "a;1,000.5;2\n", "line 2: x_mm"),
        (SEMICOLONS + "a;1,234,567;2\n", "line 2: x_mm"),
        (SEMICOLONS + "a;1'000;2\n", "line 2: x_mm"),
        (
            SEMICOLONS + "a;1,234;2.5\na;-21,345;2\n",
            "line 2: x_mm: commas may be decimal or separate thousands",
        ),
        (COMMAS + "a,1__0,2\n", "line 2: x_mm"),
        (SEMICOLONS + "a;1.5;2\nb;2,5;1\n", "line 3: x_mm: '2,5'"),
        (SEMICOLONS + "a;1.000,5;2\n", "line 2: x_mm: '1.000,5'"),
        (COMMAS + 'a,1,"2\nb,1,2\n', "line 2: a quoted field is not closed"),
        (COMMAS + 'a,1,"2\nb,1,"2\n', "line 2: a quoted field is not closed"),
        (COMMAS + 'a,1,"2"x\n', "line 2"),
        (COMMAS.encode() + b"a,1,2\n\xff,1,2\n", "line 3"),
        ("sensor,x_mm\na,2\n", "no column y_mm"),
        ("sensor,x_mm,y_mm,x_mm\na,1,2,3\n", "'x_mm'"),
        (COMMAS, "has no rows"),
        ("", "is empty"),
        ("# x\n\n", "column names"),
        ("Device: x\n" + COMMAS + "a,1,2\n", "in the first line that is no comment"),
        (b"\x1f\x8b\x08\n\n", "is compressed with gzip: unpack it"),
        (b"PK\x03\x04\n\n", "is an Excel or ZIP file: save it as CSV"),
        ("\0\1\n2", "neither CSV nor Parquet"),
    ],
)
def test_a_malformed_file_is_refused_in_one_line_with_its_place(written, text, place):
    path = written(text)
    with pytest.raises(InputError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert place in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_first_row_that_violates_a_rule_is_named(written):
    path = written(SEMICOLONS + "a;1;2\n\nnan;1;2\na;inf;1e400\n")
    with pytest.raises(InputError, match="line 4: sensor is empty"):
        read(path, require_text("sensor"))
    for column in ("x_mm", "y_mm"):
        with pytest.raises(InputError, match=f"line 5: {column}: must be a finite number"):
            read(path, require_numbers(column))


def test_a_malformed_row_is_refused_also_if_it_is_not_chosen(written):
    path = written("sensor,x_mm,y_mm,z_mm\na,1,2,3\nb,1,2\n")
    with (
        pytest.raises(InputError, match="line 3: has fewer fields"),
        open_table(path, ("sensor", "x_mm", "y_mm", "z_mm"), ()) as table,
    ):
        table.refuse(POSITIONS, "sensor = $name", name="a")


def test_parquet_rows_follow_the_same_rules(tmp_path):
    path = tmp_path / "table"
    table = {"sensor": ["a", None], "x_mm": [1.0, float("nan")], "y_mm": [2, None]}
    pq.write_table(pa.table(table), path)
    assert read(path) == [("a", 1.0, 2.0), ("", None, None)]
    pq.write_table(pa.table(table | {"x_mm": [1.0, float("inf")]}), path)
    with pytest.raises(InputError, match="row 2: x_mm"):
        read(path, require_numbers("x_mm"))


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"x_mm": ["1"]}, "x_mm: must be a column of numbers, not of VARCHAR: convert it"),
        ({"x_mm": [[1.0]]}, "x_mm: must be a column of numbers, not of DOUBLE"),
        ({"X_MM": [9.0]}, "two columns have the name 'x_mm': names must differ in more than case"),
    ],
)
def test_a_parquet_file_with_unclear_columns_is_refused(tmp_path, columns, message):
    path = tmp_path / "table.parquet"
    pq.write_table(pa.table({"sensor": ["a"], "x_mm": [1.0], "y_mm": [2.0]} | columns), path)
    with pytest.raises(InputError, match=message):
        read(path)


@pytest.mark.parametrize(
    ("unit", "name", "accepted"),
    [
        ("mm", "x [mm]", True),
        ("mm", "x [m]", False),
        ("m", "x (m)", True),
        ("mm", "x_cm", False),
        ("mm", "x_m", True),
    ],
)
def test_a_mapped_column_with_another_unit_in_its_name_is_refused(written, unit, name, accepted):
    path = written(f"{name},y_mm\n1,2\n")
    with nullcontext() if accepted else pytest.raises(InputError, match="all lengths must be in mm"):  # noqa: SIM117
        with open_table(path, ("x_mm", "y_mm"), (), mapping={"x_mm": name}, unit=unit):
            pass


@pytest.mark.parametrize("head", ["", "\n"], ids=["regular", "copied"])
@pytest.mark.parametrize(
    ("status", "measured"),
    [
        ("ok", True),
        ("OK", True),
        ("", True),
        ("NA", True),
        ("MISSING", False),
        ("missing", False),
        ("BAD_FIT", False),
    ],
)
def test_a_row_counts_only_with_the_status_ok_or_none(written, head, status, measured):
    path = written(f"sensor,status,x_mm,y_mm\n{head}a,{status},1,2\n")
    assert read(path) == (ONE if measured else [("a", None, None)])


@pytest.mark.parametrize("name", ["Status", "STATUS", "State"])
def test_the_status_of_another_program_counts_in_any_case_or_mapped(written, name):
    path = written(f"sensor,{name},x_mm,y_mm\na,Missing,1,2\n")
    assert read(path, mapping=map_columns(["State=status"] if name == "State" else [])) == [("a", None, None)]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_written_table_is_read_to_the_last_digit(tmp_path, suffix):
    x = np.array([0.1 + 0.2, np.nan, -1e-300])
    path = tmp_path / f"it's{suffix}"
    write_table({"sensor": np.array(["a", "b, c", "d"]), "x_mm": x, "y_mm": np.arange(3)}, path)
    assert read(path) == [("a", x[0], 0.0), ("b, c", None, 1.0), ("d", x[2], 2.0)]
    with pytest.raises(InputError, match="already exists"):
        write_table({"x_mm": x}, path)
