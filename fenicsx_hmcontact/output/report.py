# SPDX-License-Identifier: LGPL-3.0-or-later
"""Options of a demo, its machine-readable report, and its progress on the terminal."""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from mpi4py import MPI

import numpy as np
import rich.progress
from rich.console import Console
from rich.table import Table

from .root import on_root, write_whole

TOTAL = "total"
"""Name of the phase that runs from the making of a report to its end."""


class DemoParser(argparse.ArgumentParser):
    """Command line of a demo: its parameters, and where its report and pictures go.

    ``--report FILE.json`` and ``--out DIR`` are always there. Under ``mpirun`` every rank parses
    the same words; only rank 0 prints, all leave with the same exit code.
    """

    def __init__(
        self,
        name: str,
        description: str,
        comm: MPI.Comm = MPI.COMM_WORLD,
        *,
        quick: bool = False,
        study: bool = False,
    ) -> None:
        """Add the options every demo has.

        Args:
            name: Name of the demo; its pictures go to ``output/<name>`` unless told otherwise.
            description: What the demo shows.
            comm: Communicator.
            quick: Whether the demo takes ``--quick``.
            study: Whether the demo takes ``--study``.
        """
        self._comm = comm
        super().__init__(prog=f"{name}.py", description=description, allow_abbrev=False)
        # Python 3.12 takes -1e-3 for an option and refuses it as a value.
        self._negative_number_matcher = re.compile(r"^-\.?\d")
        run = self.add_argument_group("run")
        run.add_argument("--report", type=Path, metavar="FILE.json", help="write the report here")
        run.add_argument(
            "--out",
            type=Path,
            metavar="DIR",
            default=Path("output") / name,
            help="directory of figures and fields (default: %(default)s)",
        )
        if quick:
            run.add_argument("--quick", action="store_true", help="coarse and short: does it run?")
        if study:
            run.add_argument(
                "--study",
                action="store_true",
                help="error against time and unknowns, over meshes, steps and discretisations",
            )

    def parameter(
        self,
        flag: str,
        default: bool | int | float | str | Sequence[int] | Sequence[float],
        unit: str,
        help: str,
        *,
        choices: Sequence[str] | None = None,
    ) -> None:
        """Add a physical or numerical parameter; its type is that of the default.

        Args:
            flag: Option, such as ``--height``.
            default: Default value. A truth value gives ``--flag`` and ``--no-flag``, a sequence an
                option that takes one value or more.
            unit: Unit, ``-`` for a pure number; empty only for truth values and words.
            help: What it is.
            choices: Words to choose from.

        Raises:
            ValueError: If a number comes without a unit.
        """
        several = isinstance(default, Sequence) and not isinstance(default, str)
        kind = type(default[0]) if several else type(default)  # type: ignore[index]
        if not unit and kind not in (bool, str):
            raise ValueError(f"the parameter {flag} needs a unit, - for a pure number")
        shown = " ".join(map(_short, default)) if several else _short(default)  # type: ignore[arg-type]
        text = f"{help} [{unit}]" if unit else help
        settings: dict[str, Any] = {
            "default": default,
            "help": f"{text} (default: {shown})".replace("%", "%%"),
        }
        if kind is bool:
            settings["action"] = argparse.BooleanOptionalAction
        else:
            settings["type"] = _finite if kind is float else kind
            settings["choices"] = choices
            settings["nargs"] = "+" if several else None
            settings["metavar"] = None if choices else kind.__name__.upper()
        self.add_argument(flag, **settings)

    def parse_modes(
        self, words: Sequence[str] | None, modes: Mapping[str, Mapping[str, Any]]
    ) -> argparse.Namespace:
        """Parse a command line on which some options, the modes, stand for values of others.

        Args:
            words: The command line; None for that of the process.
            modes: By mode, the values of the options that are left out. Of several modes the last
                one counts.

        Returns:
            The options, as of ``parse_args``.
        """
        names = {name for values in modes.values() for name in values}
        left_out = {name: self.get_default(name) for name in names}
        self.set_defaults(**dict.fromkeys(names))
        options = self.parse_args(words)
        for mode, values in modes.items():
            left_out |= values if getattr(options, mode) else {}
        for name, value in left_out.items():
            if getattr(options, name) is None:
                setattr(options, name, value)
        return options

    def parameters(self, options: argparse.Namespace) -> dict[str, Any]:
        """Pick from the parsed options what the report keeps as parameters.

        Args:
            options: What ``parse_args`` returned.
        """
        return {k: v for k, v in vars(options).items() if k not in ("report", "out")}

    def _print_message(self, message: str, file: Any = None) -> None:
        if self._comm.rank == 0:
            super()._print_message(message, file)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"{text} is not a finite number")
    return value


def _short(value: object) -> str:
    """Text of a value in a table or a help line."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value)


class Report:
    """What a run did, how long it took and what came out.

    Attributes:
        unknowns: Number of unknowns, or numbers by field.
        steps: Number of accepted time steps.
        newton_iterations: Newton iterations over all steps.
        figures: Results by name: numbers, arrays, or dictionaries of these.
    """

    def __init__(self, name: str, comm: MPI.Comm, parameters: Mapping[str, Any]) -> None:
        """Start the clock.

        Args:
            name: Name of the demo.
            comm: Communicator.
            parameters: Parameters of the run.
        """
        self.name = name
        self.comm = comm
        self.parameters = dict(parameters)
        self.unknowns: int | dict[str, int] = 0
        self.steps = 0
        self.newton_iterations = 0
        self.figures: dict[str, Any] = {}
        self._seconds: dict[str, float] = {}
        self._start = time.perf_counter()

    def step(self, newton_iterations: int) -> None:
        """Count an accepted step.

        Args:
            newton_iterations: Newton iterations it took.
        """
        self.steps += 1
        self.newton_iterations += newton_iterations

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the wall time spent inside to a phase.

        Args:
            name: Name of the phase; phases of one name add up.

        Raises:
            ValueError: If the phase is called "total", which is the report's own.
        """
        if name == TOTAL:
            raise ValueError(f"a phase cannot be called {TOTAL!r}: that is the time of the run")
        start = time.perf_counter()
        try:
            yield
        finally:
            self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - start

    def timing(self) -> dict[str, float]:
        """Wall seconds of each phase and of the run, the largest of all ranks. Collective."""
        mine = {**self._seconds, TOTAL: time.perf_counter() - self._start}
        seconds: dict[str, float] = {}
        for theirs in self.comm.allgather(mine):
            for phase, value in theirs.items():
                seconds[phase] = max(value, seconds.get(phase, 0.0))
        seconds[TOTAL] = seconds.pop(TOTAL)
        return seconds

    def write(self, path: str | Path | None) -> None:
        """Write the report of rank 0 as JSON, all of it or nothing. Collective.

        Args:
            path: File; None writes nothing.

        Raises:
            ValueError: If a figure or parameter is NaN or infinite; names it.
            TypeError: If one is no number, text, array or dictionary of these; names it.
            OSError: If the file cannot be written.
        """
        timing = self.timing()
        if path is not None:
            on_root(self.comm, lambda: write_whole(Path(path), self._document(timing)))

    def _document(self, timing: dict[str, float]) -> bytes:
        document = {
            "name": self.name,
            "parameters": _plain(self.parameters, "parameter"),
            "unknowns": _plain(self.unknowns, "unknowns"),
            "ranks": self.comm.size,
            "steps": int(self.steps),
            "newton_iterations": int(self.newton_iterations),
            "timing": timing,
            "figures": _plain(self.figures, "figure"),
        }
        return (json.dumps(document, indent=2, allow_nan=False) + "\n").encode()

    def table(self, file: IO[str] | None = None) -> None:
        """Print figures and timing on rank 0. Collective.

        Args:
            file: Where to print; standard output by default.
        """
        timing = self.timing()
        if self.comm.rank != 0:
            return
        counts = {
            "unknowns": self.unknowns,
            "ranks": self.comm.size,
            "steps": self.steps,
            "newton iterations": self.newton_iterations,
        }
        table = Table(title=self.name, show_header=False)
        table.add_column()
        table.add_column(justify="right")
        for rows in (counts, self.figures, {f"{phase} [s]": s for phase, s in timing.items()}):
            for label, value in _rows(rows):
                table.add_row(label, value)
            table.add_section()
        # No markup: rich would take a unit such as [s] for a style.
        Console(file=file, markup=False, highlight=False).print(table)


def _key(key: object) -> str:
    """Key of a figure: a time of 100.0 becomes "100"."""
    return key if isinstance(key, str) else f"{key:.12g}"


def _plain(value: Any, name: str) -> Any:
    """Convert to what JSON knows, refusing what is not finite by its name."""
    if isinstance(value, Mapping):
        return {_key(k): _plain(v, f"{name} {_key(k)!r}") for k, v in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist(), name)
    if isinstance(value, list | tuple):
        return [_plain(v, name) for v in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"the {name} is {value}")
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"the {name} is a {type(value).__name__}, which a report cannot hold")


def _rows(values: Mapping[Any, Any], above: str = "") -> Iterator[tuple[str, str]]:
    """Lines of the table: dictionaries opened, arrays by their size."""
    for key, value in values.items():
        label = f"{above}{_key(key)}"
        if isinstance(value, np.ndarray | np.generic):
            value = value.tolist()
        if isinstance(value, Mapping):
            yield from _rows(value, f"{label}, ")
        elif isinstance(value, list | tuple):
            yield label, f"({len(value)} values)"
        else:
            yield label, _short(value)


def progress[T](
    iterable: Iterable[T],
    comm: MPI.Comm,
    description: str,
    *,
    total: float | None = None,
    position: Callable[[T], float] | None = None,
) -> Iterator[T]:
    """Show a bar with the time left while iterating.

    Only rank 0 shows it, and only where standard output is a terminal; everywhere else the items
    pass in silence, and logs stay clean.

    Args:
        iterable: Items, such as time steps.
        comm: Communicator.
        description: What runs.
        total: Where the run ends: the number of items, or the end time in [s] where ``position``
            is given. The length of the iterable by default.
        position: How far an item is, such as its time [s]; needed where steps differ in length.

    Raises:
        ValueError: If ``position`` comes without ``total``.
    """
    if position is not None and total is None:
        raise ValueError("progress by position needs the total")
    # Not rich's own test: FORCE_COLOR, as many a CI sets it, would count as a terminal.
    if comm.rank != 0 or not sys.stdout.isatty():
        yield from iterable
        return
    if total is None and isinstance(iterable, Sequence):
        total = len(iterable)
    columns = (
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.TaskProgressColumn(),
        rich.progress.TimeRemainingColumn(elapsed_when_finished=True),
    )
    with rich.progress.Progress(*columns) as bar:
        task = bar.add_task(description, total=total)
        for count, item in enumerate(iterable, start=1):
            yield item
            bar.update(task, completed=count if position is None else position(item))
