# SPDX-License-Identifier: LGPL-3.0-or-later
import io
import json
import os
import pty
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from fenicsx_hmcontact.output.report import DemoParser, Report, progress

PATHS = os.pathsep.join([str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")])


def column_parser(comm):
    parser = DemoParser("column", "A column consolidates.", comm, quick=True, study=True)
    parser.parameter("--height", 1.0, "m", "height of the column")
    parser.parameter("--cells", 20, "-", "cells across, at 100 % of the width")
    parser.parameter("--times", (1e2, 1e4), "s", "times of the profiles")
    parser.parameter("--single", False, "", "one block instead of two")
    parser.parameter("--case", "tied", "", "how the blocks meet", choices=("tied", "sliding"))
    return parser


def test_defaults_and_types(comm):
    options = column_parser(comm).parse_args([])
    assert options.report is None
    assert options.out == Path("output/column")
    assert not options.quick and not options.study
    assert column_parser(comm).parameters(options) == {
        "height": 1.0,
        "cells": 20,
        "times": (1e2, 1e4),
        "single": False,
        "case": "tied",
        "quick": False,
        "study": False,
    }


def test_values_from_the_command_line(comm):
    words = "--height -1e-3 --cells 4 --times 1 2e3 -5 --single --case sliding --out a/b --study"
    options = column_parser(comm).parse_args([*words.split(), "--report", "r.json"])
    assert (options.height, options.cells, options.times) == (-1e-3, 4, [1.0, 2e3, -5.0])
    assert (options.single, options.case, options.study) == (True, "sliding", True)
    assert (options.out, options.report) == (Path("a/b"), Path("r.json"))


def test_help_shows_units_and_defaults(comm, capsys):
    with pytest.raises(SystemExit) as left:
        column_parser(comm).parse_args(["--help"])
    assert left.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    if comm.rank == 0:
        for line in (
            "--height FLOAT height of the column [m] (default: 1)",
            "--cells INT cells across, at 100 % of the width [-] (default: 20)",
            "times of the profiles [s] (default: 100 10000)",
            "--single, --no-single one block instead of two (default: no)",
            "--case {tied,sliding} how the blocks meet (default: tied)",
            "--out DIR directory of figures and fields (default: output/column)",
            "--report FILE.json",
        ):
            assert line in shown
    else:
        assert shown == ""


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--hight", "2"], "unrecognized arguments: --hight"),
        (["--heig", "2"], "unrecognized arguments: --heig"),
        (["--height", "nan"], "nan is not a finite number"),
        (["--cells", "1.5"], "invalid int value"),
        (["--case", "glued"], "invalid choice: 'glued'"),
    ],
)
def test_wrong_options_end_all_ranks_and_rank_0_says_why(comm, capsys, words, message):
    with pytest.raises(SystemExit) as left:
        column_parser(comm).parse_args(words)
    assert left.value.code == 2
    said = capsys.readouterr().err
    assert message in said if comm.rank == 0 else said == ""


def test_modes_set_what_is_left_out(comm):
    modes = {"quick": {"cells": 4, "height": 0.5}, "study": {"cells": 8}}
    for words, cells, height in (
        ([], 20, 1.0),
        (["--quick"], 4, 0.5),
        (["--quick", "--cells", "7"], 7, 0.5),
        (["--quick", "--study"], 8, 0.5),
        (["--cells", "20", "--study"], 20, 1.0),
    ):
        options = column_parser(comm).parse_modes(words, modes)
        assert (options.cells, options.height) == (cells, height)


def test_number_without_unit_is_refused(comm):
    with pytest.raises(ValueError, match="--height needs a unit"):
        DemoParser("column", "", comm).parameter("--height", 1.0, "", "height")


@pytest.mark.parametrize(("word", "code"), [("--help", 0), ("--wrong", 2)])
def test_parser_under_mpirun(comm, word, code, tmp_path):
    if comm.size > 1 or shutil.which("mpirun") is None:
        pytest.skip("starts mpirun itself")
    script = tmp_path / "column.py"
    script.write_text(
        "from fenicsx_hmcontact.output.report import DemoParser\n"
        "DemoParser('column', 'A column consolidates.').parse_args()\n"
    )
    done = subprocess.run(
        ["mpirun", "-n", "2", sys.executable, script, word],
        env={**os.environ, "PYTHONPATH": PATHS},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == code
    assert (done.stdout + done.stderr).count("usage: column.py") == 1


@pytest.mark.mpi
def test_report_holds_what_the_run_did(comm, shared_tmp_path):
    report = Report("column", comm, {"height": 1.0, "out": Path("a"), "study": False, "k": None})
    report.unknowns = {"u": 12, "p": np.int64(6)}
    for iterations in (3, 4):
        report.step(iterations)
    report.figures["error"] = np.float64(0.5)
    report.figures["profile"] = np.arange(6).reshape(2, 3) / 4
    report.figures["by_time"] = {"100": 1.5, 1000.0: np.float32(0.25), 2: (True, np.int32(7))}
    path = shared_tmp_path / "new" / "report.json"
    report.write(path)

    comm.Barrier()
    kept = json.loads(path.read_text())
    assert kept.pop("timing")["total"] > 0
    assert kept == {
        "name": "column",
        "parameters": {"height": 1.0, "out": "a", "study": False, "k": None},
        "unknowns": {"u": 12, "p": 6},
        "ranks": comm.size,
        "steps": 2,
        "newton_iterations": 7,
        "figures": {
            "error": 0.5,
            "profile": [[0.0, 0.25, 0.5], [0.75, 1.0, 1.25]],
            "by_time": {"100": 1.5, "1000": 0.25, "2": [True, 7]},
        },
    }
    assert [file.name for file in path.parent.iterdir()] == ["report.json"]


@pytest.mark.mpi
def test_timing_is_that_of_the_slowest_rank(comm):
    report = Report("column", comm, {})
    slowest = comm.size - 1
    for _ in range(2):
        with report.phase("assembly"):
            time.sleep(0.1 if comm.rank == slowest else 0.0)
    if comm.rank == 0:
        with report.phase("picture"):
            time.sleep(0.05)
    with pytest.raises(KeyError), report.phase("broken off"):
        raise KeyError
    timing = report.timing()
    assert timing == comm.bcast(timing)
    assert list(timing)[-1] == "total"
    assert 0.2 <= timing["assembly"] <= timing["total"]
    assert timing["picture"] >= 0.05
    assert timing["broken off"] >= 0.0
    with pytest.raises(ValueError, match="total"), report.phase("total"):
        pass


@pytest.mark.mpi
@pytest.mark.parametrize(
    ("figures", "error", "message"),
    [
        ({"jump": np.nan}, ValueError, "figure 'jump' is nan"),
        ({"errors": {"100": np.array([1.0, -np.inf])}}, ValueError, "'errors' '100' is -inf"),
        ({"mesh": object()}, TypeError, "figure 'mesh' is a object"),
        ({"phase": 1j}, TypeError, "figure 'phase' is a complex"),
    ],
)
def test_a_figure_that_is_no_number_is_refused_on_all_ranks(
    comm, shared_tmp_path, figures, error, message
):
    report = Report("column", comm, {})
    if comm.rank == 0:
        report.figures = figures
    path = shared_tmp_path / "report.json"
    with pytest.raises(error, match=message):
        report.write(path)
    assert list(shared_tmp_path.iterdir()) == []


@pytest.mark.mpi
def test_a_report_that_cannot_be_written_is_an_error_on_all_ranks(comm, shared_tmp_path):
    if comm.rank == 0:
        (shared_tmp_path / "file").touch()
    report = Report("column", comm, {})
    with pytest.raises(OSError):
        report.write(shared_tmp_path / "file" / "report.json")
    report.write(None)


@pytest.mark.mpi
def test_table(comm):
    report = Report("column", comm, {})
    report.unknowns = 42
    report.figures = {"error": {100.0: np.float64(1.25e-3)}, "profile": np.zeros(7)}
    with report.phase("assembly"):
        pass
    text = io.StringIO()
    report.table(text)
    shown = text.getvalue()
    if comm.rank == 0:
        rows = [line.split("│")[1:3] for line in shown.splitlines() if "│" in line]
        values = {label.strip(): value.strip() for label, value in rows}
        assert values["unknowns"] == "42"
        assert values["error, 100"] == "0.00125"
        assert values["profile"] == "(7 values)"
        assert float(values["assembly [s]"]) < 1.0
        assert list(values)[-1] == "total [s]"
    else:
        assert shown == ""


@pytest.mark.mpi
def test_progress_is_silent_in_logs(comm, capfd, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    assert list(progress(range(5), comm, "steps")) == [0, 1, 2, 3, 4]
    assert list(progress(iter("ab"), comm, "steps", total=3.0, position=len)) == ["a", "b"]
    assert capfd.readouterr() == ("", "")


def test_progress_by_position_needs_the_end(comm):
    with pytest.raises(ValueError, match="needs the total"):
        list(progress([1.0], comm, "steps", position=float))


def test_progress_on_a_terminal(comm, monkeypatch):
    parent, child = pty.openpty()
    monkeypatch.setenv("TERM", "xterm")
    with os.fdopen(child, "w") as terminal:
        monkeypatch.setattr(sys, "stdout", terminal)
        times = iter([10.0, 20.0, 40.0])
        taken = list(progress(times, comm, "footing", total=40.0, position=float))
        terminal.write("after")
        terminal.flush()
        shown = b""
        while not shown.endswith(b"after"):
            shown += os.read(parent, 65536)
    os.close(parent)
    assert taken == [10.0, 20.0, 40.0]
    assert (b"footing" in shown and b"100%" in shown) == (comm.rank == 0)
