import json
from pathlib import Path

import pytest

from jaxsafe.schema.errors import ConfigError
from jaxsafe.storage.files import (
    append_csv,
    append_rows,
    keep_rows,
    read_json,
    read_rows,
    write_json,
    write_text,
)
from jaxsafe.storage.forms import COUNT, NUMBER_OR_NULL, OTHERS, numbers


def test_a_last_line_cut_short_by_a_kill_is_not_a_row(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    append_rows(log, [{"step": 1}, {"step": 2}])
    log.write_text(log.read_text()[:-4])
    assert read_rows(log) == [{"step": 1}]


def test_a_broken_line_in_the_middle_is_an_error_that_names_it(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    log.write_text('{"step": 1}\n{"st\n{"step": 3}\n')
    with pytest.raises(ConfigError, match=r"log\.jsonl, line 2: not a line of JSON"):
        read_rows(log)


def test_a_line_that_is_no_row_of_the_log_is_an_error_that_names_it(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    for line in ('{"a": 1}', "[1]", "null0"):
        log.write_text(line + "\n")
        with pytest.raises(ConfigError, match=r"log\.jsonl, line 1: not a "):
            read_rows(log, {"step": COUNT})


@pytest.mark.parametrize(
    ("row", "fault"),
    [
        ({"step": "1"}, r"step: expected a whole number ≥ 0, found '1'"),
        ({"step": True}, "step: expected a whole number ≥ 0, found True"),
        ({"step": 2**64}, "step: expected a whole number ≥ 0, found 1844674"),
        ({"step": 1, "at": [{"x": "0"}]}, r"at\.\[0\]\.x: expected a number or null, found '0'"),
        ({"step": 1, "at": {}}, r"at: expected a list, found {}"),
        (
            {"step": 1, "at": [], "more": []},
            r"more: expected a list of length 2, each a number or null, found \[\]",
        ),
        (
            {"step": 1, "at": []},
            "more: expected a list of length 2, each a number or null, found nothing",
        ),
    ],
)
def test_a_row_of_another_form_is_told_with_its_line_and_place(
    tmp_path: Path, row: dict, fault: str
) -> None:
    log = tmp_path / "log.jsonl"
    log.write_text('{"step": 0, "at": [], "more": [1, null]}\n' + json.dumps(row) + "\n")
    with pytest.raises(ConfigError, match=rf"log\.jsonl, line 2: not a row of this log: {fault}"):
        read_rows(log, {"step": COUNT, "at": [{OTHERS: NUMBER_OR_NULL}], "more": numbers(2)})


@pytest.mark.parametrize(
    "text",
    ["[" * 40 + "]" * 40, "[" * 10**6, '{"a":' * 40 + "0" + "}" * 40, "NaN", "[Infinity]", "{"],
)
def test_what_is_nested_deeply_or_no_json_is_not_read(tmp_path: Path, text: str) -> None:
    for name, read, wrong in (
        ("x.json", read_json, "not a JSON file"),
        ("x.jsonl", read_rows, "line 1: not a line of JSON"),
    ):
        (tmp_path / name).write_text(f"{text}\n")
        with pytest.raises(ConfigError, match=wrong):
            read(tmp_path / name)


def test_logs_are_cut_back_to_the_rows_to_keep(tmp_path: Path) -> None:
    log = tmp_path / "log.jsonl"
    append_rows(log, ({"step": step} for step in range(5)))
    assert (
        keep_rows(log, lambda row: row["step"] < 2) == read_rows(log) == [{"step": 0}, {"step": 1}]
    )
    assert keep_rows(tmp_path / "none.jsonl", lambda row: True) == []


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    file = tmp_path / "results.json"
    write_json(file, {"a": 1.0})
    with pytest.raises(TypeError):
        write_json(file, {"a": object()})
    assert file.read_text() == '{\n  "a": 1.0\n}\n'
    assert [path.name for path in tmp_path.iterdir()] == ["results.json"]


def test_nan_is_null_in_json(tmp_path: Path) -> None:
    append_rows(tmp_path / "log.jsonl", [{"a": float("nan"), "b": [float("inf"), 1.0]}])
    assert read_rows(tmp_path / "log.jsonl") == [{"a": None, "b": [None, 1.0]}]


def test_csv_has_one_header(tmp_path: Path) -> None:
    for value in (1, 2):
        append_csv(tmp_path / "log.csv", [{"a": value, "b": None}])
    assert (tmp_path / "log.csv").read_text() == "a,b\n1,\n2,\n"


def test_write_text_makes_missing_directories(tmp_path: Path) -> None:
    write_text(tmp_path / "a" / "b.txt", "c")
    assert (tmp_path / "a" / "b.txt").read_text() == "c"
