# SPDX-License-Identifier: LGPL-3.0-or-later
"""A run over meshes that change: steps, remeshes, stages, checkpoints (Section 3.4)."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from .domain import Domain, MeshArrays, NodalState, gather_states, scatter_states
from .output.checkpoint import CheckpointError, read_checkpoint, write_checkpoint
from .output.root import on_root
from .remeshing import (
    Quality,
    Remeshed,
    Remeshing,
    Transfer,
    angles,
    areas,
    due,
    remesh,
    target_sizes,
)
from .solvers import StepOptions, TimeStepping, TransientModel

_log = logging.getLogger(__name__)

DIMENSION = 2
"""Components of a displacement."""

type Build = Callable[[Domain], TransientModel]
"""Makes the model of a run on a domain: spaces, forms, conditions and pairs."""


@dataclass(frozen=True)
class RemeshRecord:
    """What a remesh did, the same on all ranks.

    Attributes:
        step: Number of the step after which it was done, from 1 on.
        t: Time [s].
        reasons: Why, by body.
        counts: How often each operation was done, by body.
        unsettled: Bodies that would have changed further in more rounds.
        n_nodes: Number of nodes afterwards.
        smallest_angle: Smallest angle of all triangles before and afterwards [degrees].
        merged: Area that bodies gained where boundary nodes were removed or creases filled, by body
            [m^2].
        merged_total: The same with each triangle counted as positive.
        merged_water: Area gained by porous bodies, which is the water and the grains in it [m^2].
        histories: Integral of each history before and afterwards [m^2].
        gap_volumes: Volume of the gap of each pair with water before and afterwards [m^2].
        seconds: Wall time.
    """

    step: int
    t: float
    reasons: dict[str, list[str]]
    counts: dict[str, dict[str, int]]
    unsettled: list[str]
    n_nodes: int
    smallest_angle: tuple[float, float]
    merged: dict[str, float]
    merged_total: float
    merged_water: float
    histories: dict[str, tuple[float, float]]
    gap_volumes: dict[str, tuple[float, float]]
    seconds: float

    def __str__(self) -> str:
        """Say in one line what was done and why."""
        bodies = (
            f"{body} ({'; '.join(why)}): "
            + ", ".join(f"{n} {word}" for word, n in self.counts[body].items() if n)
            for body, why in self.reasons.items()
        )
        low, high = self.smallest_angle
        return (
            f"remesh after t = {self.t:g} s: {', '.join(bodies)}; {self.n_nodes} nodes, smallest "
            f"angle {low:.3g} to {high:.3g} degrees, area {sum(self.merged.values()):+.2g} m^2"
        )


class Simulation(TimeStepping):
    """Steps of a model whose mesh is rebuilt where its triangles get poor.

    After a step that is accepted the triangles are looked at; where they call for it they are built
    anew over the nodes, and spaces, forms, conditions and pairs on them by the same function that
    built the first. What nodes know stays on them: displacements, pressures, stresses, histories,
    axes, the state of contact. New nodes get convex combinations.

    Args:
        build: Makes the model on a domain. It is called again after each remesh, and must depend on
            nothing but the domain and what does not change.
        domain: The first domain.
        remeshing: When and how to remesh; None never does.
        options: How the length of steps follows failure and success.
        start: Time at the start [s].

    Attributes:
        domain: The present domain.
        model: The present model, as ``build`` returned it.
        remeshing: Options of remeshing.
        records: What the remeshes did.
        n_steps: Number of accepted steps whose end is the start of the next.

    Note:
        Collective.
    """

    model: TransientModel

    def __init__(
        self,
        build: Build,
        domain: Domain,
        remeshing: Remeshing | None = None,
        *,
        options: StepOptions = StepOptions(),
        start: float = 0.0,
    ) -> None:
        super().__init__(build(domain), options, start=start)
        self.domain, self.remeshing, self._build = domain, remeshing, build
        self.records: list[RemeshRecord] = []
        self.n_steps = 0
        # On rank 0 alone
        self._arrays = domain.arrays()
        self._sizes = target_sizes(self._arrays)
        self._quality: dict[str, Quality] = {}

    def accept(self) -> None:
        """Make the end of the last step the start of the next, on a new mesh if due. Collective."""
        if not self._to_accept:
            return
        super().accept()
        self.n_steps += 1
        before = self._arrays
        self._arrays = replace(before, points=self.domain.points())
        if self.remeshing is not None:
            reasons = self._due(before)
            if reasons:
                self.remesh(reasons)

    def remesh(self, reasons: Mapping[str, Sequence[str]]) -> None:
        """Rebuild the triangles of bodies, and everything on them. Collective.

        Args:
            reasons: Why, by body; other bodies stay as they are.

        Raises:
            TriangulationError: If a body has no triangulation, as where its boundary crosses
                itself.
            ValueError: If there are no options of remeshing, or no such body.
        """
        options = self.remeshing
        if options is None:
            raise ValueError("a run without remeshing= has no options to remesh by")
        self.accept()
        begin, comm = time.perf_counter(), self.model.comm
        arrays, layers = self._arrays, self.domain.layers
        result = on_root(
            comm, lambda: remesh(arrays, self._sizes, options, names=list(reasons), layers=layers)
        )
        if result is not None:
            self._quality |= result.quality
        if not comm.bcast(result is not None and result.changed):
            return
        known, whole = self._known(), self._gather()
        record: dict[str, Any] = {}
        if result is not None:
            both = (arrays, result.arrays)
            record = self._booked(result, _porous(whole, len(arrays.points))) | {
                "step": self.n_steps,
                "t": self.t,
                "reasons": {body: list(why) for body, why in reasons.items()},
                "counts": result.counts,
                "unsettled": result.unsettled,
                "n_nodes": len(result.arrays.points),
                "smallest_angle": tuple(float(angles(a.points, a.cells).min()) for a in both),
            }
            arrays, whole = result.arrays, _carried(whole, result.transfer)
        self._continue(arrays, layers, whole)
        if result is not None:
            self._sizes = result.sizes
        record = comm.bcast(record)
        for name, after in self._known().items():
            record[name] = {key: (known[name][key], value) for key, value in after.items()}
        record["seconds"] = time.perf_counter() - begin
        self.records.append(RemeshRecord(**record))
        if comm.rank == 0:
            _log.info("%s", self.records[-1])

    def rebuild(self) -> None:
        """Build everything anew on the same triangles, as after a remesh. Collective."""
        self.accept()
        self._continue(self._arrays, self.domain.layers, self._gather())

    def remove(self, group: str, exposed: str) -> None:
        """Take a group out of the ground between two stages, as in an excavation. Collective.

        Args:
            group: Name of the body group.
            exposed: Name of the surface group of what is laid bare; a new one, or one there is.

        Raises:
            ValueError: If there is no such group, or nothing would be left.
        """
        self.accept()
        layers = {
            body: [name for name in names if name != group]
            for body, names in self.domain.layers.items()
        }
        layers = {body: names for body, names in layers.items() if names}
        found = on_root(self.model.comm, lambda: self._arrays.without(group, exposed))
        arrays, whole, sizes = self._arrays, self._gather(), self._sizes
        if found is not None:
            (arrays, kept), n = found, len(arrays.points)
            whole, sizes = _carried(whole, Transfer.subset(kept, n)), sizes[kept]
        self._continue(arrays, layers, whole)
        self._sizes, self._quality = sizes, {}

    def reset_displacements(self) -> None:
        """Begin a stage at the design geometry: stresses, histories and pressures stay. Collective.

        The mesh goes back to where displacements were zero, as after the weight of the ground has
        come to rest in it. The steps to come measure displacements from there.
        """
        self.accept()
        arrays, whole = self._arrays, self._gather()
        moves = self.model.follow is not None
        for name, state in whole.items():
            if name.startswith("field ") and state.nodal["value"].shape[1] == DIMENSION:
                if moves:
                    points = arrays.points.copy()
                    points[:, :DIMENSION] -= state.nodal["value"]
                    arrays = replace(arrays, points=points)
                state.nodal["value"][:] = 0.0
            if name == "axes":
                state.nodal["angle"][:] = 0.0
        self._continue(arrays, self.domain.layers, whole)

    # --- checkpoints --------------------------------------------------------------------------

    def write_checkpoint(self, path: str | Path) -> None:
        """Write all that the run needs to go on, to one file. Collective.

        The last step is accepted first. Nothing that a run leaves in its solvers is written; this
        run forgets it too, so that both go on alike: to the last bit on one rank; on several, where
        MUMPS adds up as messages come in, to round-off.

        Args:
            path: The file; one of that name is replaced once the new one is whole.

        Raises:
            OSError: On all ranks, if it cannot be written.
            ValueError: If something in the model cannot be carried over.
        """
        self.accept()
        states = self.model.nodal_state()
        whole, mesh = self._gather(states), self._arrays
        arrays = {f"mesh {name}": getattr(mesh, name) for name in _MESH}
        arrays |= {"sizes": self._sizes}
        arrays |= {
            f"state {name}/{key}": table
            for name, state in whole.items()
            for key, table in state.nodal.items()
        }
        description = {
            "stepping": self.save(),
            "n_steps": self.n_steps,
            "records": [asdict(record) for record in self.records],
            "quality": {body: asdict(quality) for body, quality in self._quality.items()},
            "remeshing": None if self.remeshing is None else self.remeshing.described(),
            "values": {name: state.values for name, state in states.items()},
            "bodies": self.domain.bodies,
            "surfaces": self.domain.surfaces,
            "layers": {body: list(names) for body, names in self.domain.layers.items()},
            "name": self.domain.name,
        }
        on_root(self.model.comm, lambda: write_checkpoint(path, arrays, description))
        self.model.set_nodal_state(states)

    @classmethod
    def restart(
        cls,
        path: str | Path,
        build: Build,
        comm: MPI.Comm,
        remeshing: Remeshing | None = None,
        *,
        options: StepOptions = StepOptions(),
    ) -> Self:
        """Go on from a checkpoint, on any number of ranks. Collective.

        Args:
            path: The file.
            build: As of the run that wrote it.
            comm: Communicator.
            remeshing: As of the run that wrote it; other options hold from here on.
            options: Likewise.

        Raises:
            FileNotFoundError: On all ranks, if there is no such file.
            CheckpointError: On all ranks, if it is no checkpoint, damaged, of another version, or
                that of another model.
        """
        found = on_root(comm, lambda: read_checkpoint(path))
        description = comm.bcast(found and found[1])
        mesh, whole, sizes = None, {}, np.empty(0)
        if found:
            arrays = found[0]
            sizes = arrays["sizes"]
            mesh = MeshArrays(
                **{name: arrays[f"mesh {name}"] for name in _MESH},
                bodies=description["bodies"],
                surfaces=description["surfaces"],
            )
            everywhere = np.arange(len(mesh.points))
            for name, values in description["values"].items():
                start = f"state {name}/"
                nodal = {
                    key.removeprefix(start): table
                    for key, table in arrays.items()
                    if key.startswith(start)
                }
                whole[name] = NodalState(everywhere, nodal, values)
        domain = Domain.from_arrays(
            mesh, comm, name=description["name"], layers=description["layers"]
        )
        run = cls(build, domain, remeshing, options=options)
        run.restore(description["stepping"])
        run.prescribe(run.t, float(run.model.dt.value))
        known, wanted = description["values"], run.model.nodal_state()
        if set(known) != set(wanted):
            raise CheckpointError(
                f"{path} is that of another model, with {', '.join(known)}; this one has "
                f"{', '.join(wanted)}"
            )
        try:
            run._take_over(whole)
        except ValueError as error:
            raise CheckpointError(f"{path} is that of another model: {error}") from error
        run._sizes = sizes
        run._quality = {body: Quality(**q) for body, q in description["quality"].items()}
        run.records = [RemeshRecord(**_tuples(record)) for record in description["records"]]
        run.n_steps = description["n_steps"]
        return run

    # --- what it is made of -------------------------------------------------------------------

    def report(self) -> dict[str, Any]:
        """What remeshing did and what drifted, for the report of a run. Collective."""
        records = self.records
        return {
            "remeshing": None if self.remeshing is None else self.remeshing.described(),
            "remeshes": len(records),
            "remeshing_seconds": sum(record.seconds for record in records),
            "smallest_angle": min((r.smallest_angle[1] for r in records), default=None),
            "merged_area": sum(sum(record.merged.values()) for record in records),
            "merged_area_total": sum(record.merged_total for record in records),
            "merged_water": sum(record.merged_water for record in records),
            "gap_volume_change": sum(
                after - before for r in records for before, after in r.gap_volumes.values()
            ),
            "history_drifts": self.drifts(),
        }

    def drifts(self) -> dict[str, float]:
        """How far the integral of each history is from what the steps booked, relative. Collective.

        Both are exact integrals; cells that change under values that stay make the difference.
        """
        return {
            name: integral / booked - 1.0 if booked else 0.0
            for name, (integral, booked) in self.model.problem.integrals().items()
        }

    def _due(self, before: MeshArrays) -> dict[str, list[str]]:
        """Why bodies call for a remesh after the last step. Collective."""
        options, now = self.remeshing, self._arrays
        assert options is not None

        def look() -> dict[str, list[str]]:
            ratios = areas(now.points, now.cells) / areas(before.points, before.cells)
            return due(
                now,
                self._sizes,
                options,
                step=self.n_steps,
                after_last=self._quality,
                area_ratios=ratios,
                layers=self.domain.layers,
            )

        comm = self.model.comm
        found: dict[str, list[str]] = comm.bcast(on_root(comm, look))
        return found

    def _gather(self, states: Mapping[str, NodalState] | None = None) -> dict[str, NodalState]:
        """What all nodes hold, on rank 0. Collective."""
        states = self.model.nodal_state() if states is None else states
        return gather_states(self.model.comm, states, len(self._arrays.points))

    def _continue(
        self, arrays: MeshArrays, layers: Mapping[str, Sequence[str]], whole: dict[str, NodalState]
    ) -> None:
        """Build the model on another mesh, from what all its nodes hold. Collective.

        Args:
            arrays: The mesh, on rank 0.
            layers: Its bodies of several groups.
            whole: State of its nodes, on rank 0.
        """
        comm, name = self.model.comm, self.domain.name
        mesh = arrays if comm.rank == 0 else None
        domain = Domain.from_arrays(mesh, comm, name=name, layers=layers)
        dt = float(self.model.dt.value)
        self.domain, self.model = domain, self._build(domain)
        self.prescribe(self.t, dt)
        self._arrays = domain.arrays()
        self._take_over(whole)

    def _take_over(self, whole: dict[str, NodalState]) -> None:
        """Give the model what all nodes hold, from rank 0. Collective."""
        model = self.model
        model.set_nodal_state(scatter_states(model.comm, whole, model.nodal_state()))

    def _known(self) -> dict[str, dict[str, float]]:
        """Integrals of histories and volumes of gaps, which a remesh may change. Collective."""
        problem = self.model.problem
        histories = {name: integral for name, (integral, _) in problem.integrals().items()}
        return {"histories": histories, "gap_volumes": problem.gap_volumes()}

    def _booked(self, result: Remeshed, porous: npt.NDArray[np.bool_]) -> dict[str, Any]:
        """Areas that went with removed nodes of boundaries; on rank 0."""
        merges, domain = result.merges, self.domain
        owner = {domain.bodies[name]: name for name in domain.bodies}
        for body, names in domain.layers.items():
            owner |= {domain.bodies[name]: body for name in names}
        merged = dict.fromkeys(owner.values(), 0.0)
        for area, group in zip(merges.areas, merges.groups, strict=True):
            merged[owner[int(group)]] += float(area)
        wet = merges.weights @ porous.astype(float) > 0.5
        return {
            "merged": merged,
            "merged_total": float(np.abs(merges.areas).sum()),
            "merged_water": float(merges.areas[wet].sum()),
        }


_MESH = tuple(f.name for f in fields(MeshArrays) if f.name not in ("bodies", "surfaces"))


def _carried(whole: Mapping[str, NodalState], transfer: Transfer) -> dict[str, NodalState]:
    """What the nodes hold after some have come and gone."""
    return {
        name: NodalState(
            np.arange(len(transfer.kept) + transfer.weights.shape[0]),
            {key: transfer(values) for key, values in state.nodal.items()},
            state.values,
        )
        for name, state in whole.items()
    }


def _porous(whole: Mapping[str, NodalState], n: int) -> npt.NDArray[np.bool_]:
    """Which nodes have a scalar field, which is a pore pressure."""
    found = np.zeros(n, bool)
    for name, state in whole.items():
        values = state.nodal.get("value")
        if name.startswith("field ") and values is not None and values.shape[1] == 1:
            found |= np.isfinite(values[:, 0])
    return found


def _tuples(record: dict[str, Any]) -> dict[str, Any]:
    """A record as it was before JSON made lists of its pairs."""
    pairs = {
        name: {key: tuple(pair) for key, pair in record[name].items()}
        for name in ("histories", "gap_volumes")
    }
    return record | pairs | {"smallest_angle": tuple(record["smallest_angle"])}
